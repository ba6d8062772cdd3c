"""Arguments of ``downsample`` at their limits: refused, or equal to others."""

import numpy as np
import pytest
import torch

from mops_lightning import downsample
from mops_lightning.errors import UserError

CLOUD = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 7
WIDE = torch.cat([CLOUD, CLOUD[:, :1]], 1)
"""The same with a further column."""
FEW = [1] * 4 + [0] * 196
"""Weights of four points."""


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"spacing": 0}, "spacing must be a number above 0"),
        ({"voxel": float("inf")}, "voxel must be a number above 0"),
        ({"spacing": True}, "spacing must be a number above 0"),
        ({"spacing": 1, "method": "random"}, "method needs m"),
        ({"spacing": 1, "start": 3}, "start is for method='fps'"),
        ({"spacing": 1, "readout": "generated"}, "spacing keeps input points"),
        ({"spacing": 1, "readout": None}, "readout must be completed or generated"),
        ({"m": 5, "readout": None}, "readout: unknown None"),
        ({"m": 5, "method": ""}, "method: unknown ''"),
        ({"m": 500}, "m must be at most the number of points N=200"),
        ({"m": [5, 6]}, "m: 2 numbers for 1 clouds"),
        ({"m": 5, "space": (1, 1)}, "space must hold a factor of at least 0 for each of the 3"),
        ({"m": 5, "space": (1, 1, 1), "method": "random"}, "space is for method='fps'"),
        ({"m": 5, "tile": 1}, "tile must be a whole number of at least 2"),
        ({"voxel": 1e-20}, "voxel: 1e-20 is too small"),
        ({"voxel": 0.5, "space": (1, 1, 1)}, "space is for fps, poisson and spacing; voxels are"),
        (
            {"voxel": 0.5, "readout": "generated", "weight": [1] * 200},
            "weight: the means of voxels",
        ),
        ({"voxel": 0.5, "start": "farthest"}, "start is for method='fps'"),
        ({"m": 5, "space": (1, 1, 1), "tile": 50}, "give space or tile, not both"),
        ({"m": 5, "tile": True}, "tile must be a whole number of at least 2"),
        ({"m": 5, "tile": 50, "weight": [1] * 200}, "weight needs the whole cloud at once"),
        ({"m": 5, "tile": 50, "readout": "generated"}, "tile keeps different input points"),
        ({"m": 5, "space": (1, 1, 1), "start": 200}, "start must be less than the number .* N=200"),
        ({"m": 5, "space": (1, 1, 1), "weight": FEW}, "4 points have a weight above 0, fewer than"),
    ],
)
def test_mistakes_are_one_line(arguments, words):
    with pytest.raises(UserError, match=words) as refused:
        downsample(CLOUD, **arguments)

    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("budget", [{"spacing": 0.3}, {"voxel": 0.5}])
def test_matched_sets_of_a_distance_are_the_completed_ones(budget):
    kept, rows = downsample(CLOUD, **budget)
    matched, same = downsample(CLOUD, readout="matched", **budget)

    assert same.tolist() == rows.tolist()
    assert matched.tolist() == kept.tolist()


def test_space_of_the_coordinates_chooses_as_without_it_also_by_weights():
    weight = torch.ones(200)
    weight[17] = 50.0

    for given in (None, weight):
        _, plain = downsample(CLOUD, 9, weight=given)
        _, scaled = downsample(CLOUD, 9, weight=given, space=(1, 1, 1))
        assert scaled.tolist() == plain.tolist()
    assert plain[0] == 17


def test_small_cloud_of_a_flat_batch_is_kept_whole():
    batch = torch.tensor([0] * 3 + [1] * 20)

    for points in (CLOUD[:23], WIDE[:23]):
        kept, rows = downsample(points, 5, batch=batch)

        assert len(kept) == 8
        assert rows[:3].tolist() == [0, 1, 2]
        assert (rows[3:] >= 3).all()
        assert torch.equal(kept, points[rows])


def test_whole_numbers_of_map_coordinates_are_not_rounded():
    numbers = (100 * CLOUD).round().long()

    _, rows = downsample(numbers, 9, start=0)
    _, far_away = downsample(numbers + 2**30, 9, start=0)

    assert far_away.tolist() == rows.tolist()


def test_arrays_of_another_byte_order_give_the_same_rows():
    array = CLOUD.numpy()

    kept, rows = downsample(array, 9)
    swapped, same = downsample(array.astype(">f4"), 9)

    assert same.tolist() == rows.tolist()
    assert np.array_equal(swapped, kept)


def test_columns_and_rows_outside_of_the_cloud_are_refused():
    with pytest.raises(UserError, match=r"points must have shape .* got \(200, 2\)"):
        downsample(CLOUD[:, :2], 5)
    with pytest.raises(UserError, match="start must be less than the number of points N=200"):
        downsample(CLOUD.numpy(), 5, start=200)
    unknown = WIDE.clone()
    unknown[3, 3] = float("nan")
    with pytest.raises(UserError, match="space: a column is not finite"):
        downsample(unknown, 5, space=(1, 1, 1, 1))
    assert len(downsample(unknown, 5, space=(1, 1, 1, 0))[0]) == 5
