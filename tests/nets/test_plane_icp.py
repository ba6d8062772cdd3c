"""Point-to-plane ICP, beside NumPy's least squares and small_gicp."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from mops_lightning.errors import UserError
from mops_lightning.nets.plane_icp import PlaneICP, nearest_rows, surface_normals, weighted_step
from mops_lightning.ops.rigid import motion_of_vectors, rotation_angle
from tests.ops.test_stability import box


@pytest.fixture
def pair():
    """Two samples of one box, and the motion between them."""
    source = torch.from_numpy(box(600, seed=1))[None] / 4
    target = torch.from_numpy(box(600, seed=2))[None] / 4
    turn = torch.tensor([[0.05, -0.1, 0.08]])
    shift = torch.tensor([[0.03, 0.0, -0.02]])
    true = motion_of_vectors(turn, shift)
    return source.float(), true.apply(target.float()), true


def random_system(rng, number):
    """Return levers, residuals and weights of a batch of one."""
    levers = torch.from_numpy(rng.normal(size=(1, number, 6)))
    residuals = torch.from_numpy(rng.normal(size=(1, number)))
    weights = torch.from_numpy(rng.random((1, number)))
    return levers, residuals, weights


def test_weighted_step_equals_least_squares_of_numpy():
    levers, residuals, weights = random_system(np.random.default_rng(0), 30)

    (step,) = weighted_step(levers, residuals, weights)

    roots = weights[0].sqrt().numpy()
    weighted_levers = levers[0].numpy() * roots[:, None]
    weighted_residuals = residuals[0].numpy() * roots
    expected, *_ = np.linalg.lstsq(weighted_levers, -weighted_residuals)
    assert step.numpy() == pytest.approx(expected, abs=1e-6)


def test_step_has_the_gradients_of_its_formula():
    system = random_system(np.random.default_rng(0), 9)
    arguments = [values.requires_grad_() for values in system]

    assert torch.autograd.gradcheck(weighted_step, arguments)


def test_icp_finds_the_motion_between_two_samples_of_a_box(pair):
    source, target, true = pair

    found = PlaneICP()(source, target)

    assert torch.rad2deg(rotation_angle(found.quaternion, true.quaternion)) < 0.5
    assert_close(found.translation, true.translation, atol=0.005, rtol=0)


def test_icp_ends_where_small_gicp_ends(pair):
    small_gicp = pytest.importorskip("small_gicp")
    source, target, _ = pair
    known = small_gicp.align(
        target[0].double().numpy(),
        source[0].double().numpy(),
        registration_type="PLANE_ICP",
        downsampling_resolution=1e-6,
        max_correspondence_distance=0.3,
        max_iterations=60,
    ).T_target_source

    found = PlaneICP(40)(source, target)

    moved = source[0].double().numpy() @ known[:3, :3].T + known[:3, 3]
    assert found.apply(source)[0].numpy() == pytest.approx(moved, abs=0.005)


def test_points_beyond_the_distance_have_no_effect(pair):
    source, target, _ = pair
    far = torch.cat([source, source[:, :50] + 40], 1)

    expected = PlaneICP()(source, target)

    assert_close(PlaneICP()(far, target).quaternion, expected.quaternion)


def test_gradients_of_the_last_step_reach_the_source(pair):
    source, target, _ = pair
    source.requires_grad_()

    PlaneICP(3)(source, target).quaternion[:, 1:].sum().backward()

    assert torch.isfinite(source.grad).all()
    assert source.grad.abs().sum() > 0


def test_normals_of_a_plane_are_its_direction():
    plane = torch.rand(1, 50, 3) * torch.tensor([1.0, 1.0, 0.0])

    assert surface_normals(plane)[0, :, 2].abs().numpy() == pytest.approx(1)


def test_nearest_rows_of_moved_points_are_the_points_themselves(rand):
    points = rand(2, 40, 3)

    rows, distance = nearest_rows(points + 1e-4, points)

    assert rows.tolist() == [list(range(40))] * 2
    assert distance.max() < 1e-3


@pytest.mark.parametrize("distance", [0.0, -1.0, float("inf"), float("nan")])
def test_distance_out_of_range_raises(distance):
    with pytest.raises(UserError, match="max_distance must be a number above 0"):
        PlaneICP(max_distance=distance)
