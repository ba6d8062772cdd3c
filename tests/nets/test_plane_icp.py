"""Point-to-plane ICP, beside NumPy's least squares and small_gicp."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from mops_lightning.errors import UserError
from mops_lightning.nets.plane_icp import PlaneICP, surface_normals, weighted_step
from mops_lightning.ops.rigid import identity_motion, motion_of_vectors, rotation_angle
from tests.ops.test_stability import box


@pytest.fixture
def pair():
    """Two samples of one box, and the motion between them."""
    source = box_of_points(seed=1)
    target = box_of_points(seed=2)
    turn = torch.tensor([[0.05, -0.1, 0.08]])
    shift = torch.tensor([[0.03, 0.0, -0.02]])
    true = motion_of_vectors(turn, shift)
    return source, true.apply(target), true


def box_of_points(seed):
    points = box(600, seed) / 4
    return torch.from_numpy(points).float()[None]


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


@pytest.mark.parametrize("iterations", [1, 3])
def test_icp_takes_as_many_steps_as_it_has_iterations(pair, iterations):
    source, target, _ = pair
    net = PlaneICP(iterations)
    normals = surface_normals(target)
    expected = identity_motion(source)
    for _ in range(iterations):
        expected = net.step(expected, source, target, normals)

    found = net(source, target)

    assert torch.equal(found.quaternion, expected.quaternion)
    assert torch.equal(found.translation, expected.translation)


def test_icp_finds_the_motion_between_two_samples_of_a_box(pair):
    source, target, true = pair

    found = PlaneICP()(source, target)

    angle = rotation_angle(found.quaternion, true.quaternion)
    assert torch.rad2deg(angle) < 0.5
    assert_close(found.translation, true.translation, atol=0.005, rtol=0)


def test_icp_ends_where_small_gicp_ends(pair):
    small_gicp = pytest.importorskip("small_gicp")
    source, target, _ = pair
    source_cloud = source[0].double().numpy()
    target_cloud = target[0].double().numpy()
    result = small_gicp.align(
        target_cloud,
        source_cloud,
        registration_type="PLANE_ICP",
        downsampling_resolution=1e-6,
        max_correspondence_distance=0.3,
        max_iterations=60,
    )
    rotation = result.T_target_source[:3, :3]
    translation = result.T_target_source[:3, 3]

    (found,) = PlaneICP(40)(source, target).apply(source)

    expected = source_cloud @ rotation.T + translation
    assert found.numpy() == pytest.approx(expected, abs=0.005)


def test_points_beyond_the_distance_have_no_effect(pair):
    source, target, _ = pair
    far_points = source[:, :50] + 40
    source_with_far_points = torch.cat([source, far_points], 1)

    found = PlaneICP()(source_with_far_points, target)

    expected = PlaneICP()(source, target)
    assert_close(found.quaternion, expected.quaternion)


@pytest.mark.parametrize(("max_distance", "has_effect"), [(0.25, True), (0.15, False)])
def test_points_up_to_the_distance_have_an_effect(pair, max_distance, has_effect):
    _, target, _ = pair
    x = target[0, :, 0]
    off_a_face = target[:, x > x.max() - 0.01] + torch.tensor([0.2, 0.0, 0.0])
    with_others = torch.cat([target, off_a_face], 1)

    found = PlaneICP(3, max_distance)(with_others, target)

    alone = PlaneICP(3, max_distance)(target, target)
    apart = (found.translation - alone.translation).norm()
    assert (apart > 0.001) == has_effect


def test_gradients_flow_through_the_last_step_only(pair):
    source, target, _ = pair
    source.requires_grad_()
    with torch.no_grad():
        before = PlaneICP(2)(source, target)

    motion = PlaneICP(3)(source, target)

    step = PlaneICP().step(before, source, target, surface_normals(target))
    (gradient,) = torch.autograd.grad(motion.quaternion[:, 1:].sum(), source)
    (expected,) = torch.autograd.grad(step.quaternion[:, 1:].sum(), source)
    assert_close(gradient, expected)


def test_gradients_of_the_last_step_reach_the_source(pair):
    source, target, _ = pair
    source.requires_grad_()

    motion = PlaneICP(3)(source, target)
    motion.quaternion[:, 1:].sum().backward()

    assert torch.isfinite(source.grad).all()
    assert source.grad.abs().sum() > 0


def test_normals_of_a_plane_are_its_direction():
    plane = torch.rand(1, 50, 3)
    plane[..., 2] = 0

    (normals,) = surface_normals(plane)

    assert normals[:, 2].abs().numpy() == pytest.approx(1)


@pytest.mark.parametrize("distance", [0.0, -1.0, float("inf"), float("nan")])
def test_distance_out_of_range_raises(distance):
    with pytest.raises(UserError, match="max_distance must be a number above 0"):
        PlaneICP(max_distance=distance)
