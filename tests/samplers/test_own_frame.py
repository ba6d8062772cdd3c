"""Features in a frame that turns with the cloud: samples turn with it, too."""

from typing import Any

import pytest
import torch
from torch.testing import assert_close

from mops_lightning import FMOPSNet
from mops_lightning.channels import NO_CHANNELS, Channel, PointChannels
from mops_lightning.ops.rigid import quaternion_from_euler, quaternion_to_matrix
from mops_lightning.samplers.own_frame import in_own_frame, own_axes

LAYERS: dict[str, Any] = {"feature_channels": (8, 6), "rho_channels": (12, 10)}


def moved_sampler(anchors, **settings):
    """A sampler with anchors whose columns depend on its features."""
    torch.manual_seed(0)
    sampler = FMOPSNet(6, anchors=anchors, tau_min=1.0, **LAYERS, **settings)
    for weights in sampler.queries.parameters():
        torch.nn.init.normal_(weights, std=1.0)
    return sampler.double().eval()


def turned_pair(rng):
    """Three clouds, and each under a rotation and a translation of its own."""
    clouds = torch.randn(3, 70, 3, dtype=torch.float64, generator=rng)
    angles = torch.rand(3, 3, dtype=torch.float64, generator=rng) * 3
    rotations = quaternion_to_matrix(quaternion_from_euler(angles))
    shift = torch.randn(3, 1, 3, dtype=torch.float64, generator=rng)
    turned = clouds @ rotations.mT + shift
    return clouds, turned, rotations, shift


@pytest.mark.parametrize(
    "columns",
    [
        {},
        {"candidates": 3, "neighbours": 5},
        {"neighbours": 5},
        {"candidates": 3},
    ],
)
def test_sample_of_a_turned_cloud_is_the_turned_sample(columns, rng):
    clouds, turned, rotations, shift = turned_pair(rng)
    sampler = moved_sampler("framed", **columns)

    sample = sampler(clouds).points
    sample_of_turned = sampler(turned).points

    assert_close(sample_of_turned, sample @ rotations.mT + shift)


NORMALS = PointChannels(
    (
        Channel("normal_x"),
        Channel("normal_y"),
        Channel("normal_z"),
    )
)


def test_sample_of_a_turned_cloud_with_normals_is_the_turned_sample(rng, randn):
    clouds, turned, rotations, shift = turned_pair(rng)
    points, turned_points = with_normals(clouds, turned, rotations, randn)
    sampler = moved_sampler("framed", point_channels=NORMALS)

    sample = sampler(points).points
    sample_of_turned = sampler(turned_points).points

    expected_places = sample[..., :3] @ rotations.mT + shift
    expected_normals = sample[..., 3:] @ rotations.mT
    assert_close(sample_of_turned[..., :3], expected_places)
    assert_close(sample_of_turned[..., 3:], expected_normals)


def with_normals(clouds, turned, rotations, randn):
    """Return clouds and turned clouds with normals that turn with them."""
    directions = randn(clouds.shape).double()
    normals = torch.nn.functional.normalize(directions, dim=2)
    turned_normals = normals @ rotations.mT
    points = torch.cat([clouds, normals], 2)
    turned_points = torch.cat([turned, turned_normals], 2)
    return points, turned_points


def test_sample_of_plain_anchors_does_not_turn_with_its_cloud(rng):
    clouds, turned, rotations, shift = turned_pair(rng)
    sampler = moved_sampler("fps")

    sample = sampler(clouds).points
    sample_of_turned = sampler(turned).points

    turned_sample = sample @ rotations.mT + shift
    apart = sample_of_turned - turned_sample
    assert apart.norm(dim=2).mean() > 0.001


def test_own_axes_of_known_farthest_points():
    # The mean is at the origin. Farthest: 4 along x; then −3 along x; then ±2 along z.
    points = torch.zeros(1, 7, 3)
    points[0, :3, 0] = torch.tensor([4.0, -3.0, -1.0])
    points[0, 3:5, 2] = torch.tensor([2.0, -2.0])
    points[0, 5:, 1] = torch.tensor([1.0, -1.0])

    (axes,) = own_axes(points)

    first, second, third = axes.T
    assert first.tolist() == [1, 0, 0]
    assert second.abs().tolist() == [0, 0, 1]
    assert_close(third, torch.linalg.cross(first, second))


def test_own_axes_take_the_widest_of_the_next_three_farthest_points():
    # Farthest: 10 and −9 along x; then 3 along z; then (8, 5, 0). Nine more balance the mean.
    points = torch.zeros(1, 13, 3)
    points[0, 0] = torch.tensor([10.0, 0, 0])
    points[0, 1] = torch.tensor([-9.0, 0, 0])
    points[0, 2] = torch.tensor([0, 0, 3.0])
    points[0, 3] = torch.tensor([8.0, 5.0, 0])
    points[0, 4:] = -points[0, :4].sum(0) / 9

    (axes,) = own_axes(points)

    assert_close(axes, torch.eye(3))


@pytest.mark.parametrize("radius", [1e-3, 1.0, 1e3])
def test_own_axes_of_a_narrow_cloud_are_known_from_its_width(radius):
    """Of a hundred thousandth of the radius and less, rounding would decide."""
    narrow = radius * cross_of_points(length=1.0, width=1e-4)
    line = radius * cross_of_points(length=1.0, width=1e-6)

    (of_narrow,) = own_axes(narrow)
    (of_line,) = own_axes(line)

    assert_close(of_narrow.abs(), torch.eye(3))
    assert (of_line[:, 1:] == 0).all()


def cross_of_points(length, width):
    """Return the two ends of the x axis and of the y axis around the origin."""
    points = torch.zeros(1, 4, 3)
    points[0, :2, 0] = torch.tensor([length, -length])
    points[0, 2:, 1] = torch.tensor([width, -width])
    return points


def test_own_axes_are_rotations(randn):
    clouds = randn(5, 40, 3, dtype=torch.float64)
    centred = clouds - clouds.mean(1, keepdim=True)

    axes = own_axes(centred)

    identity = torch.eye(3, dtype=torch.float64)
    for frame in axes:
        assert_close(frame.T @ frame, identity)
        assert torch.linalg.det(frame).item() == pytest.approx(1)


@pytest.mark.parametrize("number", [1, 2, 3, 9])
@pytest.mark.parametrize("direction", [[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]])
def test_points_on_one_line_give_finite_coordinates(number, direction):
    steps = torch.arange(number)
    points = steps[:, None] * torch.tensor(direction)

    (described,) = in_own_frame(points[None], NO_CHANNELS)

    centred = points - points.mean(0)
    along = described[:, 0].abs()
    aside = described[:, 1:].abs()
    assert_close(along, centred.norm(dim=1))
    assert aside.max() < 1e-5


def test_normals_turn_with_the_cloud(rng, randn):
    clouds, turned, rotations, _ = turned_pair(rng)
    points, turned_points = with_normals(clouds, turned, rotations, randn)

    described = in_own_frame(points, NORMALS)
    described_turned = in_own_frame(turned_points, NORMALS)

    assert_close(described, described_turned)
