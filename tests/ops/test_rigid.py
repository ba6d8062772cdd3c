import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mops_lightning.ops import rigid
from mops_lightning.seeding import generator
from tests.support.rigid import motion


def rotations(number=200, seed=0):
    """Return random and special rotations: none, tiny, and half turns, exact and almost."""
    axes = np.concatenate([np.eye(3), np.random.default_rng(seed).normal(size=(7, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = (0.0, 1e-12, 1e-7, 1e-3, np.pi / 2, np.pi - 1e-7, np.pi)
    special = Rotation.from_rotvec(np.concatenate([axes * angle for angle in angles]))
    return Rotation.concatenate([Rotation.random(number, random_state=seed), special])


def quaternions(rotation):
    return torch.from_numpy(np.roll(rotation.as_quat(), 1, axis=-1).copy())  # scipy: scalar last


def same_rotation(got, want, tolerance=1e-12):
    sign = torch.where((got * want).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    torch.testing.assert_close(got * sign, want, atol=tolerance, rtol=0)


def test_quaternion_to_matrix_equals_scipy():
    given = rotations()
    got = rigid.quaternion_to_matrix(quaternions(given))
    torch.testing.assert_close(got, torch.from_numpy(given.as_matrix()), atol=1e-12, rtol=0)


def test_multiply_and_conjugate_equal_scipy():
    first, second = rotations(seed=1), rotations(seed=2)
    product = rigid.quaternion_multiply(quaternions(first), quaternions(second))
    same_rotation(product, quaternions(first * second))
    same_rotation(rigid.quaternion_conjugate(quaternions(first)), quaternions(first.inv()))


def test_quaternion_from_euler_uses_fixed_axes_xyz():
    angles = np.random.default_rng(3).uniform(-np.pi, np.pi, (100, 3))
    want = Rotation.from_euler("xyz", angles)
    same_rotation(rigid.quaternion_from_euler(torch.from_numpy(angles)), quaternions(want))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_rotation_angle_equals_scipy(dtype):
    first, second = rotations(seed=1), rotations(seed=1)[::-1]
    pairs = [(first, second), (first, first)]
    for angle in (0.0, 1e-6, 1e-4, 1.0, np.pi - 1e-6, np.pi):
        pairs.append((first, first * Rotation.from_rotvec([0, 0, angle])))
    for a, b in pairs:
        got = rigid.rotation_angle(quaternions(a).to(dtype), quaternions(b).to(dtype))
        want = torch.from_numpy((a.inv() * b).magnitude()).to(dtype)
        assert torch.isfinite(got).all()
        tolerance = 1e-7 if dtype == torch.float64 else 2e-6
        torch.testing.assert_close(got, want, atol=tolerance, rtol=0)
    a, b = quaternions(first), quaternions(rotations(seed=2))  # any sign and norm
    torch.testing.assert_close(rigid.rotation_angle(-3 * a, b), rigid.rotation_angle(a, b))


def test_motion_composition_and_identity(rng):
    points = torch.randn(5, 40, 3, generator=rng)
    first, second = motion(1), motion(2)
    moved = first.apply(points)
    twice = second.after(first).apply(points)
    torch.testing.assert_close(twice, second.apply(moved), atol=1e-5, rtol=0)
    torch.testing.assert_close(rigid.identity_motion(points).apply(points), points)
    torch.testing.assert_close(moved.diff(dim=1).norm(dim=2), points.diff(dim=1).norm(dim=2))


def test_random_motion_covers_its_range():
    drawn = rigid.random_motion(45.0, 0.5, [generator(i) for i in range(2000)])
    assert drawn.translation.abs().max() <= 0.5
    assert (drawn.translation.amin(0) < -0.49).all()
    assert (drawn.translation.amax(0) > 0.49).all()
    angles = Rotation.from_quat(np.roll(drawn.quaternion.numpy(), -1, 1)).as_euler("xyz", True)
    assert np.abs(angles).max() <= 45.001
    assert (np.abs(angles).max(0) > 44).all()
    # The mean error of always predicting the identity is about 42.8 degrees.
    still = torch.tensor([1.0, 0.0, 0.0, 0.0])
    mean = torch.rad2deg(rigid.rotation_angle(drawn.quaternion, still.expand(2000, 4))).mean()
    assert 41.5 < mean < 44
