"""Points with channels beside x, y and z: what every sampler guarantees."""

from typing import Any

import numpy as np
import pytest
import torch
from torch.nn import functional as F
from torch.testing import assert_close

from mops_lightning import (
    CriticalSampler,
    FMOPSNet,
    FPSSampler,
    GumbelSampler,
    MOPSNet,
    PoissonSampler,
    ProgressiveSampleNet,
    RandomSampler,
    SampleNet,
    SampleOutput,
    Sampler,
    SerialSampler,
    SNet,
    VoxelSampler,
    nearest,
)
from mops_lightning.channels import Channel, PointChannels
from mops_lightning.errors import UserError
from mops_lightning.losses.subset import simplification_losses, subset_losses
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import stream_sample
from tests.support.samplers import MOPS_LAYERS, SMALL, moved

B, N, M = 2, 40, 8
CHANNELS = PointChannels(
    (
        Channel("intensity", 100.0, 50.0),
        Channel("normal_x"),
        Channel("normal_y"),
        Channel("normal_z"),
    )
)
INDEX = {
    "random": RandomSampler,
    "fps": FPSSampler,
    "voxel": VoxelSampler,
    "poisson": PoissonSampler,
    "serial": SerialSampler,
}


def moved_net(channels: Any, **settings: Any) -> Any:
    """Return MOPS-Net with anchors whose weights are away from their start."""
    net = MOPSNet(M, point_channels=channels, **settings, **MOPS_LAYERS)
    return moved(net)


LEARNED = {
    "gumbel": lambda channels: GumbelSampler(M, feature_channels=(8, 6), point_channels=channels),
    "mops": lambda channels: MOPSNet(M, point_channels=channels, **MOPS_LAYERS),
    "fmops": lambda channels: FMOPSNet(M, point_channels=channels, **MOPS_LAYERS),
    "anchors": lambda channels: moved_net(channels, anchors="fps"),
    "local": lambda channels: moved_net(channels, anchors="fps", candidates=2, neighbours=3),
    "snet": lambda channels: SNet(M, point_channels=channels, **SMALL),
    "samplenet": lambda channels: SampleNet(M, k=3, point_channels=channels, **SMALL),
    "progressive": lambda channels: ProgressiveSampleNet(M, k=3, point_channels=channels, **SMALL),
}


@pytest.fixture
def clouds(randn):
    """Points with a scaled intensity and normals."""
    places = randn(B, N, 3)
    intensity = randn(B, N, 1)
    normals = F.normalize(randn(B, N, 3), dim=2)
    return torch.cat([places, intensity, normals], 2)


@pytest.mark.parametrize("name", INDEX)
def test_index_sampler_selects_by_coordinates_and_brings_all_channels(name, clouds):
    sampler = INDEX[name](M)

    output = sampler(clouds)

    coordinates = clouds[..., :3].contiguous()
    expected = sampler(coordinates).indices
    assert torch.equal(output.indices, expected)
    assert torch.equal(output.points, gather_points(clouds, expected))


def test_critical_points_are_chosen_by_a_net_with_channels(clouds):
    sampler = CriticalSampler(M, PointNetVanilla(3, point_channels=CHANNELS))
    coordinates = clouds[..., :3]
    other_channels = torch.cat([coordinates, -clouds[..., 3:]], 2)

    output = sampler(clouds)
    output_of_others = sampler(other_channels)

    assert torch.equal(output.points, gather_points(clouds, output.indices))
    assert not torch.equal(output_of_others.indices, output.indices)
    with pytest.raises(UserError, match=r"points must have shape \(B, N, 7\), 4 of them channels"):
        sampler(coordinates)


@pytest.mark.parametrize("name", LEARNED)
@pytest.mark.parametrize("training", [True, False])
def test_learned_sampler_returns_channels_with_normals_of_length_one(name, training, clouds):
    sampler = LEARNED[name](CHANNELS).train(training)

    output = sampler(clouds)

    lengths = output.points[..., 4:].norm(dim=2)
    assert output.points.shape == (B, M, 7)
    assert_close(lengths, torch.ones(B, M))
    if output.soft_projected is not None:
        assert output.soft_projected.shape == (B, M, 7)
        lengths_of_projected = output.soft_projected[..., 4:].norm(dim=2)
        assert_close(lengths_of_projected, torch.ones(B, M))


@pytest.mark.parametrize("name", LEARNED)
def test_learned_sampler_reads_its_channels(name, clouds):
    sampler = LEARNED[name](CHANNELS)
    matrices = [weights for weights in sampler.parameters() if weights.ndim == 2]
    (first,) = [weights for weights in matrices if weights.shape[1] == 7]

    sampled = sampler(clouds).points[..., :3]

    (gradient,) = torch.autograd.grad(sampled.square().sum(), first)
    gradient_of_channels = gradient[:, 3:]
    assert gradient_of_channels.abs().sum() > 0


@pytest.mark.parametrize("name", ["mops", "fmops", "anchors", "local"])
def test_generated_points_are_the_transposed_matrix_times_points_and_channels(name, clouds):
    sampler = LEARNED[name](CHANNELS).eval()

    output = sampler(clouds)

    means = output.matrix.dense().mT @ clouds
    normals = F.normalize(means[..., 4:], dim=2)
    assert_close(output.points[..., :4], means[..., :4])
    assert_close(output.points[..., 4:], normals)


@pytest.mark.parametrize("name", ["snet", "samplenet", "progressive"])
def test_points_without_a_matrix_have_the_channels_of_the_nearest_point(name, clouds):
    sampler = LEARNED[name](CHANNELS).eval()

    sampled = sampler(clouds).points

    _, rows = nearest(sampled[..., :3], clouds[..., :3])
    nearest_points = gather_points(clouds, rows)
    assert torch.equal(sampled[..., 3:], nearest_points[..., 3:])


def test_simplification_loss_is_between_coordinates(clouds):
    sampler: Any = LEARNED["snet"](CHANNELS)

    output = sampler(clouds)

    places = clouds[..., :3].contiguous()
    generated = output.points[..., :3].contiguous()
    expected = simplification_losses(places, generated, [M])
    assert_close(output.losses["simplification"], sampler.alpha * expected[M])


def test_subset_loss_is_between_coordinates(clouds):
    sampler: Any = LEARNED["mops"](CHANNELS)

    output = sampler(clouds)

    places = clouds[..., :3].contiguous()
    generated = output.points[..., :3].contiguous()
    expected = subset_losses(places, generated, [M])
    assert_close(output.losses["subset"], sampler.alpha * expected[M])


@pytest.mark.parametrize("name", LEARNED)
def test_weights_have_the_names_of_a_sampler_without_channels(name):
    without = LEARNED[name](0).state_dict()
    with_channels = LEARNED[name](CHANNELS).state_dict()

    assert list(with_channels) == list(without)
    wider = []
    for key, weights in without.items():
        if weights.shape != with_channels[key].shape:
            wider.append(key)
            assert with_channels[key].shape[1] == weights.shape[1] + 4
    assert len(wider) == 1


@pytest.mark.parametrize("name", LEARNED)
def test_points_with_other_channels_are_refused(name, clouds):
    without = LEARNED[name](0)
    with_channels = LEARNED[name](CHANNELS)

    with pytest.raises(UserError, match=r"shape \(B, N, 3\), got \(2, 40, 7\)"):
        without(clouds)
    with pytest.raises(UserError, match=r"shape \(B, N, 7\), 4 of them channels beside x, y and z"):
        with_channels(clouds[..., :3])


def test_own_sampler_without_channels_sees_coordinates_only(clouds):
    class FirstPoints(Sampler):
        def sample(self, points, m):
            assert points.shape == (B, N, 3)
            rows = torch.arange(m).expand(len(points), m)
            return SampleOutput(points[:, :m], rows, {})

    output = FirstPoints(M)(clouds)

    assert torch.equal(output.points, clouds[:, :M])


@pytest.mark.parametrize("channels", [-1, 1.5, True, "intensity"])
def test_wrong_number_of_channels_raises(channels):
    with pytest.raises(UserError, match="point_channels must be a whole number from 0 to 1000, or"):
        MOPSNet(M, point_channels=channels)


def test_streamed_sample_equals_the_whole(clouds):
    sampler = LEARNED["mops"](CHANNELS).eval()

    chunks = clouds[0].split(15)

    streamed = stream_sample(sampler, lambda: chunks)

    whole, _ = sampler(clouds).points
    assert_close(streamed, whole)


def test_downsample_without_the_channels_names_them(clouds):
    sampler = LEARNED["mops"](CHANNELS).eval()

    with pytest.raises(UserError, match=r"with columns x, y, z, intensity, normal_x, .* \(40, 3\)"):
        sampler.downsample(clouds[0, :, :3])


def test_downsample_of_missing_values_says_how_many(clouds):
    sampler = LEARNED["mops"](CHANNELS).eval()
    cloud = clouds[0].clone()
    cloud[3:6, 3] = torch.nan

    with pytest.raises(UserError, match="points: 3 of 40 values of intensity are not finite"):
        sampler.downsample(cloud)


def test_downsample_by_an_index_sampler_keeps_all_columns(clouds):
    cloud = clouds[0]
    coordinates = cloud[:, :3]
    sampler = FPSSampler(M)

    points, rows = sampler.downsample(cloud)

    _, expected = sampler.downsample(coordinates)
    assert torch.equal(rows, expected)
    assert torch.equal(points, cloud[rows])


def test_point_channels_takes_a_number_of_numpy():
    assert PointChannels.of(np.int64(2)) == PointChannels.of(2)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ("intensity", "takes a list of Channel, got 'i' in it"),
        (["intensity"], "takes a list of Channel, got 'intensity' in it"),
        ([Channel("intensity", 0.5, 0.0)], "intensity: .* above 0, got mean 0.5 and scale 0.0"),
        ([Channel("intensity", 0.5, -1.0)], "intensity: .* above 0, got mean 0.5 and scale -1.0"),
        ([Channel("intensity", float("nan"))], "intensity: .* finite, .* got mean nan"),
    ],
)
def test_point_channels_name_a_wrong_column(columns, message):
    with pytest.raises(UserError, match=message):
        PointChannels(columns)


@pytest.fixture
def cloud_in_own_units(clouds):
    """The first cloud with coordinates around 1000 and an intensity around 100."""
    cloud = clouds[0].double()
    cloud[:, :3] = 1000 + 20 * cloud[:, :3]
    cloud[:, 3] = 100 + 50 * cloud[:, 3]
    return cloud


def test_downsample_returns_chosen_points_in_the_units_that_were_given(clouds, cloud_in_own_units):
    sampler = LEARNED["mops"](CHANNELS).eval()

    points, rows = sampler.downsample(cloud_in_own_units, readout="completed")

    selected: Any = sampler.select("completed", normalised(clouds[0])[None], M)
    _, (expected_rows,) = selected
    assert torch.equal(rows, expected_rows)
    assert torch.equal(points, cloud_in_own_units[rows])


def test_downsample_maps_generated_channels_back(clouds, cloud_in_own_units):
    sampler = LEARNED["mops"](CHANNELS).eval()

    points, _ = sampler.downsample(cloud_in_own_units, readout="generated")

    selected: Any = sampler.select("generated", normalised(clouds[0])[None], M)
    (seen,), _ = selected
    intensity = 100 + 50 * seen[:, 3]
    assert_close(points[:, 3], intensity.double())
    assert_close(points[:, 4:], seen[:, 4:].double())


def normalised(cloud):
    """Return a cloud with its coordinates in the unit sphere."""
    centred = cloud[:, :3] - cloud[:, :3].mean(0)
    radius = centred.norm(dim=1).max()
    return torch.cat([centred / radius, cloud[:, 3:]], 1)
