"""Channels of points: names, statistics, and normals that follow the cloud."""

import math
from typing import Any

import pytest
import torch

from mops_lightning.channels import (
    Channel,
    PointChannels,
    coordinates,
    with_coordinates,
)
from mops_lightning.errors import UserError

NORMALS = [Channel("normal_x"), Channel("normal_y"), Channel("normal_z")]
MIXED = PointChannels([Channel("intensity", 100.0, 50.0), *NORMALS, Channel("time")])


def test_channels_know_their_names_features_and_normals():
    assert len(MIXED) == 5
    assert MIXED.names == ("intensity", "normal_x", "normal_y", "normal_z", "time")
    assert MIXED.features == ("intensity", "normals", "time")
    assert MIXED.normals == 4
    assert PointChannels([Channel("time")]).normals is None
    assert not PointChannels()


def test_channels_are_equal_with_equal_names_and_statistics():
    same = PointChannels(MIXED.columns)
    other = PointChannels([Channel("intensity", 100.0, 51.0), *MIXED.columns[1:]])

    assert same == MIXED
    assert hash(same) == hash(MIXED)
    assert other != MIXED
    assert MIXED.columns != MIXED


@pytest.mark.parametrize(
    ("mean", "scale"),
    [(math.nan, 1.0), (math.inf, 1.0), (0.0, 0.0), (0.0, -1.0), (0.0, math.nan), (0.0, math.inf)],
)
def test_channel_without_a_usable_mean_and_scale_is_refused(mean, scale):
    with pytest.raises(UserError, match="time: a channel's mean and scale must be finite"):
        PointChannels([Channel("time", mean, scale)])


def test_column_that_is_no_channel_is_refused():
    column: Any = ("time", 0.0, 1.0)
    with pytest.raises(UserError, match="PointChannels takes a list of Channel, got"):
        PointChannels([column])


def test_number_of_channels_gives_them_names():
    assert PointChannels.of(2).names == ("channel_1", "channel_2")
    assert PointChannels.of(0) == PointChannels()
    assert len(PointChannels.of(1000)) == 1000
    assert PointChannels.of(MIXED) is MIXED
    for wrong in (1001, -1, True, 1.0, "2", None):
        with pytest.raises(UserError, match="a whole number from 0 to 1000"):
            PointChannels.of(wrong)


def test_channels_are_written_as_plain_data_and_read_back():
    plain = MIXED.to_plain()

    assert plain[0] == ["intensity", 100.0, 50.0]
    assert PointChannels.from_plain(plain) == MIXED


@pytest.mark.parametrize(
    "rows",
    [
        "intensity",
        ["intensity"],
        [["intensity", 0.0]],
        [["intensity", 0.0, 1.0, 2.0]],
        [[1, 0.0, 1.0]],
        [["a", 0.0, 1.0]] * 1001,
    ],
    ids=lambda rows: str(rows)[:40],
)
def test_plain_data_that_are_no_channels_are_refused(rows):
    with pytest.raises(ValueError, match="channel"):
        PointChannels.from_plain(rows)


def test_scaled_values_are_those_of_files_by_mean_and_scale():
    channels = PointChannels([Channel("intensity", 100.0, 50.0), Channel("time", -1.0, 0.5)])
    values = torch.tensor([[150.0, 0.0], [50.0, -1.0]], dtype=torch.float64)

    scaled = channels.scaled(values)

    assert scaled.tolist() == [[1.0, 2.0], [-1.0, 0.0]]
    assert scaled.dtype == torch.float64
    assert channels.restored(scaled).tolist() == values.tolist()


def test_missing_values_are_refused_with_their_channel_and_number():
    channels = PointChannels([Channel("intensity"), Channel("time")])
    values = torch.zeros(4, 2)
    channels.check_known(values, "a.ply")

    values[1, 1] = math.nan
    values[3, 1] = math.inf

    with pytest.raises(UserError, match=r"^a\.ply: 2 of 4 values of time are not finite"):
        channels.check_known(values, "a.ply")


def cloud(rng):
    """Two clouds of all channels, with normals of length 1."""
    points = torch.randn(2, 6, 8, generator=rng, dtype=torch.float64)
    return MIXED.renormalised(points)


def others_of(points):
    """The channels that are no normals."""
    return points[..., [3, 7]]


def test_renormalised_changes_normals_only_and_keeps_zeros(rng):
    points = torch.randn(2, 6, 8, generator=rng)
    points[0, 0, 4:7] = 0

    renormalised = MIXED.renormalised(points)

    lengths = renormalised[..., 4:7].norm(dim=-1)
    assert float(lengths[0, 0]) == 0
    torch.testing.assert_close(lengths[1], torch.ones(6))
    torch.testing.assert_close(
        renormalised[..., 4:7] * points[..., 4:7].norm(dim=-1, keepdim=True), points[..., 4:7]
    )
    assert torch.equal(renormalised[..., :4], points[..., :4])
    assert torch.equal(renormalised[..., 7], points[..., 7])


TURN = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def test_rotated_turns_coordinates_and_normals_alike(rng):
    points = cloud(rng)

    turned = MIXED.rotated(points, TURN.expand(2, 3, 3))

    for first in (0, 4):
        x, y, z = points[..., first : first + 3].unbind(-1)
        expected = torch.stack([-y, x, z], -1)
        torch.testing.assert_close(turned[..., first : first + 3], expected)
    assert torch.equal(others_of(turned), others_of(points))
    without = PointChannels([Channel("time")])
    assert torch.equal(
        without.rotated(points[..., [0, 1, 2, 7]], TURN.expand(2, 3, 3))[..., 3], points[..., 7]
    )


def test_stretched_and_mapped_normals_stay_normal_to_their_surface():
    """A plane x + y = 0, stretched by 2 along x, becomes x / 2 + y = 0."""
    side = 0.5**0.5
    row = [1.0, -1.0, 0.0, 9.0, side, side, 0.0, 7.0]
    points = torch.tensor([[row]], dtype=torch.float64)
    normal = torch.tensor([0.5, 1.0, 0.0], dtype=torch.float64)
    expected = [2.0, -1.0, 0.0, 9.0, *(normal / normal.norm()).tolist(), 7.0]
    factors = torch.tensor([[[2.0, 1.0, 1.0]]], dtype=torch.float64)

    stretched = MIXED.stretched(points, factors)
    mapped = MIXED.mapped(points, torch.diag_embed(factors[:, 0]))

    assert stretched[0, 0].tolist() == pytest.approx(expected)
    assert mapped[0, 0].tolist() == pytest.approx(expected)


def test_mapped_normals_of_a_shear_stay_normal_to_their_surface():
    """The plane z = 0 of x and y, sheared to z = x."""
    shear = torch.eye(3, dtype=torch.float64)
    shear[0, 2] = 1
    points = torch.tensor([[[1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]]], dtype=torch.float64)

    mapped = MIXED.mapped(points, shear[None])

    side = 0.5**0.5
    assert mapped[0, 0].tolist() == pytest.approx([1.0, 2.0, 1.0, 0.0, -side, 0.0, side, 0.0])


def test_coordinates_are_the_first_three_columns(rng):
    points = cloud(rng)
    moved = points[..., :3] + 1

    assert torch.equal(coordinates(points), points[..., :3])
    assert coordinates(moved) is moved
    assert with_coordinates(moved, points[..., :3]).shape[-1] == 3
    together = with_coordinates(points, moved)
    assert torch.equal(together[..., :3], moved)
    assert torch.equal(together[..., 3:], points[..., 3:])
