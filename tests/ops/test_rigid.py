"""Quaternions and rigid motions against SciPy."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from mops_lightning.ops import rigid
from mops_lightning.seeding import generator
from tests.support.rigid import motion

ANGLES = (0.0, 1e-12, 1e-7, 1e-3, np.pi / 2, np.pi - 1e-7, np.pi)


def rotations(number=200, seed=0):
    """Return random and special rotations: none, tiny, and half turns, exact and almost."""
    rng = np.random.default_rng(seed)
    random_axes = rng.normal(size=(7, 3))
    axes = np.concatenate([np.eye(3), random_axes])
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    unit_axes = axes / lengths
    vectors = np.concatenate([unit_axes * angle for angle in ANGLES])
    at_random = Rotation.random(number, random_state=seed)
    special = Rotation.from_rotvec(vectors)
    return Rotation.concatenate([at_random, special])


def quaternions(rotation):
    return torch.from_numpy(rotation.as_quat(scalar_first=True))


def same_rotation(got, want, tolerance=1e-12):
    product = (got * want).sum(-1, keepdim=True)
    sign = torch.where(product < 0, -1.0, 1.0)
    assert_close(got * sign, want, atol=tolerance, rtol=0)


def test_quaternion_to_matrix_equals_scipy():
    given = rotations()

    matrices = rigid.quaternion_to_matrix(quaternions(given))

    expected = torch.from_numpy(given.as_matrix())
    assert_close(matrices, expected, atol=1e-12, rtol=0)


def test_multiply_equals_scipy():
    first = rotations(seed=1)
    second = rotations(seed=2)

    product = rigid.quaternion_multiply(quaternions(first), quaternions(second))

    same_rotation(product, quaternions(first * second))


def test_conjugate_equals_scipy():
    given = rotations(seed=1)

    inverse = rigid.quaternion_conjugate(quaternions(given))

    same_rotation(inverse, quaternions(given.inv()))


def test_quaternion_from_euler_uses_fixed_axes_xyz():
    angles = np.random.default_rng(3).uniform(-np.pi, np.pi, (100, 3))

    turned = rigid.quaternion_from_euler(torch.from_numpy(angles))

    expected = Rotation.from_euler("xyz", angles)
    same_rotation(turned, quaternions(expected))


TOLERANCES = {torch.float64: 1e-7, torch.float32: 2e-6}


def check_angle(first, second, dtype):
    """Compare the angles between two series of rotations with SciPy's."""
    of_first = quaternions(first).to(dtype)
    of_second = quaternions(second).to(dtype)

    angle = rigid.rotation_angle(of_first, of_second)

    difference = first.inv() * second
    expected = difference.magnitude()
    assert torch.isfinite(angle).all()
    assert_close(angle, torch.from_numpy(expected).to(dtype), atol=TOLERANCES[dtype], rtol=0)


@pytest.mark.parametrize("dtype", TOLERANCES)
def test_rotation_angle_of_random_pairs_equals_scipy(dtype):
    first = rotations(seed=1)

    check_angle(first, first[::-1], dtype)
    check_angle(first, first, dtype)


@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-4, 1.0, np.pi - 1e-6, np.pi])
def test_rotation_angle_of_known_turns_equals_scipy(angle, dtype):
    first = rotations(seed=1)
    turn = Rotation.from_rotvec([0, 0, angle])

    check_angle(first, first * turn, dtype)


def test_rotation_angle_takes_quaternions_of_any_sign_and_norm():
    first = quaternions(rotations(seed=1))
    second = quaternions(rotations(seed=2))

    angle = rigid.rotation_angle(-3 * first, second)

    assert_close(angle, rigid.rotation_angle(first, second))


def test_motion_after_another_moves_points_twice(randn):
    points = randn(5, 40, 3)
    first = motion(1)
    second = motion(2)

    twice = second.after(first).apply(points)

    one_by_one = second.apply(first.apply(points))
    assert_close(twice, one_by_one, atol=1e-5, rtol=0)


def test_identity_motion_keeps_points(randn):
    points = randn(5, 40, 3)

    moved = rigid.identity_motion(points).apply(points)

    assert_close(moved, points)


def test_motion_keeps_distances(randn):
    points = randn(5, 40, 3)

    moved = motion(1).apply(points)

    distances = points.diff(dim=1).norm(dim=2)
    assert_close(moved.diff(dim=1).norm(dim=2), distances)


def motions_of_2000_seeds():
    generators = [generator(number) for number in range(2000)]
    return rigid.random_motion(45.0, 0.5, generators)


def test_random_motion_covers_its_translations():
    drawn = motions_of_2000_seeds()

    smallest = drawn.translation.amin(0)
    largest = drawn.translation.amax(0)
    assert drawn.translation.abs().max() <= 0.5
    assert (smallest < -0.49).all()
    assert (largest > 0.49).all()


def test_random_motion_covers_its_angles():
    drawn = motions_of_2000_seeds()

    rotation = Rotation.from_quat(drawn.quaternion.numpy(), scalar_first=True)
    angles = np.abs(rotation.as_euler("xyz", degrees=True))
    assert angles.max() <= 45.001
    assert (angles.max(0) > 44).all()


def test_random_motion_has_the_mean_angle_of_its_range():
    drawn = motions_of_2000_seeds()
    still = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(2000, 4)

    angles = rigid.rotation_angle(drawn.quaternion, still)

    # Of always predicting the identity, about 42.8 degrees.
    mean_angle = torch.rad2deg(angles).mean()
    assert 41.5 < mean_angle < 44
