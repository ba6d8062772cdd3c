"""Points with channels beside x, y and z: what every sampler guarantees."""

from typing import Any

import numpy as np
import pytest
import torch
from torch.nn import functional as F

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
    Sampler,
    SerialSampler,
    SNet,
    VoxelSampler,
    nearest,
)
from mops_lightning.channels import Channel, PointChannels
from mops_lightning.errors import UserError
from mops_lightning.losses.subset import subset_losses
from mops_lightning.nets.pointnet import PointNetVanilla
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
LEARNED = {
    "gumbel": lambda channels: GumbelSampler(M, feature_channels=(8, 6), point_channels=channels),
    "mops": lambda channels: MOPSNet(M, point_channels=channels, **MOPS_LAYERS),
    "fmops": lambda channels: FMOPSNet(M, point_channels=channels, **MOPS_LAYERS),
    "anchors": lambda channels: moved(
        MOPSNet(M, anchors="fps", point_channels=channels, **MOPS_LAYERS)
    ),
    "local": lambda channels: moved(
        MOPSNet(
            M, anchors="fps", candidates=2, neighbours=3, point_channels=channels, **MOPS_LAYERS
        )
    ),
    "snet": lambda channels: SNet(M, point_channels=channels, **SMALL),
    "samplenet": lambda channels: SampleNet(M, k=3, point_channels=channels, **SMALL),
    "progressive": lambda channels: ProgressiveSampleNet(M, k=3, point_channels=channels, **SMALL),
}


@pytest.fixture
def clouds(rng):
    """Points with a scaled intensity and normals."""
    places = torch.randn(B, N, 3, generator=rng)
    intensity = torch.randn(B, N, 1, generator=rng)
    normals = F.normalize(torch.randn(B, N, 3, generator=rng), dim=2)
    return torch.cat([places, intensity, normals], 2)


@pytest.mark.parametrize("name", INDEX)
def test_index_sampler_selects_by_coordinates_and_brings_all_channels(name, clouds):
    sampler = INDEX[name](M)

    output = sampler(clouds)

    expected = sampler(clouds[..., :3].contiguous()).indices
    assert torch.equal(output.indices, expected)
    for b in range(B):
        assert torch.equal(output.points[b], clouds[b][expected[b]])


def test_critical_points_are_chosen_by_a_net_with_channels(clouds):
    net = PointNetVanilla(3, point_channels=CHANNELS)
    changed = torch.cat([clouds[..., :3], -clouds[..., 3:]], 2)

    output = CriticalSampler(M, net)(clouds)

    assert torch.equal(output.points[0], clouds[0][output.indices[0]])
    assert not torch.equal(CriticalSampler(M, net)(changed).indices, output.indices)
    with pytest.raises(UserError, match=r"points must have shape \(B, N, 7\), 4 of them channels"):
        CriticalSampler(M, net)(clouds[..., :3])


@pytest.mark.parametrize("name", LEARNED)
@pytest.mark.parametrize("training", [True, False])
def test_learned_sampler_returns_channels_with_normals_of_length_one(name, training, clouds):
    sampler = LEARNED[name](CHANNELS).train(training)

    output = sampler(clouds)

    assert output.points.shape == (B, M, 7)
    torch.testing.assert_close(output.points[..., 4:].norm(dim=2), torch.ones(B, M))
    if output.soft_projected is not None:
        assert output.soft_projected.shape == (B, M, 7)


@pytest.mark.parametrize("name", LEARNED)
def test_learned_sampler_reads_its_channels(name, clouds):
    sampler = LEARNED[name](CHANNELS)
    (first,) = [p for p in sampler.parameters() if p.ndim == 2 and p.shape[1] == 7]

    output = sampler(clouds).points

    (gradient,) = torch.autograd.grad(output[..., :3].square().sum(), first)
    assert gradient[:, 3:].abs().sum() > 0


@pytest.mark.parametrize("name", ["mops", "fmops", "anchors", "local"])
def test_generated_points_are_the_transposed_matrix_times_points_and_channels(name, clouds):
    sampler = LEARNED[name](CHANNELS).eval()

    output = sampler(clouds)

    expected = output.matrix.dense().mT @ clouds
    torch.testing.assert_close(output.points[..., :4], expected[..., :4])
    torch.testing.assert_close(output.points[..., 4:], F.normalize(expected[..., 4:], dim=2))


@pytest.mark.parametrize("name", ["snet", "samplenet", "progressive"])
def test_points_without_a_matrix_have_the_channels_of_the_nearest_point(name, clouds):
    output = LEARNED[name](CHANNELS).eval()(clouds)

    rows = nearest(output.points[..., :3], clouds[..., :3])[1]
    for b in range(B):
        assert torch.equal(output.points[b, :, 3:], clouds[b, rows[b], 3:])


def test_subset_loss_is_between_coordinates(clouds):
    sampler: Any = LEARNED["mops"](CHANNELS)

    output = sampler(clouds)

    expected = subset_losses(clouds[..., :3].contiguous(), output.points[..., :3].contiguous(), [M])
    torch.testing.assert_close(output.losses["subset"], sampler.alpha * expected[M])


@pytest.mark.parametrize("name", LEARNED)
def test_weights_have_the_names_of_a_sampler_without_channels(name):
    without = LEARNED[name](0).state_dict()
    with_channels = LEARNED[name](CHANNELS).state_dict()

    assert list(with_channels) == list(without)
    different = [key for key in without if without[key].shape != with_channels[key].shape]
    assert len(different) == 1
    assert with_channels[different[0]].shape[1] == without[different[0]].shape[1] + 4


@pytest.mark.parametrize("name", LEARNED)
def test_points_with_other_channels_are_refused(name, clouds):
    with pytest.raises(UserError, match=r"shape \(B, N, 3\), got \(2, 40, 7\)"):
        LEARNED[name](0)(clouds)
    with pytest.raises(UserError, match=r"shape \(B, N, 7\), 4 of them channels beside x, y and z"):
        LEARNED[name](CHANNELS)(clouds[..., :3])


def test_own_sampler_without_channels_sees_coordinates_only(clouds):
    class FirstPoints(Sampler):
        def sample(self, points, m):
            assert points.shape == (B, N, 3)
            rows = torch.arange(m).expand(len(points), m)
            return RandomSampler(m)(points)._replace(points=points[:, :m], indices=rows)

    output = FirstPoints(M)(clouds)

    assert torch.equal(output.points, clouds[:, :M])


@pytest.mark.parametrize("channels", [-1, 1.5, True, "intensity"])
def test_wrong_number_of_channels_raises(channels):
    with pytest.raises(UserError, match="point_channels must be a whole number from 0 to 1000, or"):
        MOPSNet(M, point_channels=channels)


def test_streamed_sample_equals_the_whole(clouds):
    sampler = LEARNED["mops"](CHANNELS).eval()

    streamed = stream_sample(sampler, lambda: iter(clouds[0].split(15)))

    torch.testing.assert_close(streamed, sampler(clouds).points[0])


@pytest.mark.parametrize("readout", ["generated", "completed"])
def test_downsample_scales_channels_and_maps_them_back(readout, clouds):
    sampler = LEARNED["mops"](CHANNELS).eval()
    cloud = clouds[0]
    centred = cloud[:, :3] - cloud[:, :3].mean(0)
    seen = torch.cat([centred / centred.norm(dim=1).max(), cloud[:, 3:]], 1)
    in_own_units = cloud.double()
    in_own_units[:, :3] = 1000 + 20 * in_own_units[:, :3]
    in_own_units[:, 3] = 100 + 50 * in_own_units[:, 3]

    points, indices = sampler.downsample(in_own_units, readout=readout)

    selected: Any = sampler.select(readout, seen[None], M)
    expected, rows = selected
    if readout == "completed":
        assert torch.equal(indices, rows[0])
        assert torch.equal(points, in_own_units[indices])
    else:
        torch.testing.assert_close(points[:, 3], 100 + 50 * expected[0, :, 3].double())
        torch.testing.assert_close(points[:, 4:], expected[0, :, 4:].double())


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
    points, indices = FPSSampler(M).downsample(clouds[0])

    assert torch.equal(points, clouds[0][indices])
    assert torch.equal(indices, FPSSampler(M).downsample(clouds[0, :, :3])[1])


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
