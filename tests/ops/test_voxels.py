"""Voxels of a given size beside a plain twin with exact fractions."""

from collections import defaultdict
from fractions import Fraction
from math import floor

import numpy as np
import pytest

from mops_lightning.errors import UserError
from mops_lightning.ops import voxels
from mops_lightning.ops.voxels import occupied, representatives

RNG = np.random.default_rng(0)
CLOUDS = {
    "random": RNG.normal(size=(400, 3)),
    "ties": RNG.integers(-3, 4, (300, 3)) * 0.25,
    "copies": np.repeat(RNG.normal(size=(60, 3)), 4, axis=0),
    "map": RNG.uniform(0, 3, (300, 3)) + np.array([512_345.678901, 5_412_345.678901, 312.5]),
    "one": np.array([[1.0, -2.0, 3.0]]),
}


def in_voxels(point, size):
    """Return exact coordinates of a point, in sizes of a voxel."""
    return [Fraction(float(value / size)) for value in point]


def plain_voxels(points, size):
    """Return the rows of every voxel, and the exact mean of its points in voxels."""
    rows = defaultdict(list)
    for row, point in enumerate(points):
        rows[cell_of(point, size)].append(row)
    means = {}
    for cell, members in rows.items():
        exact = [in_voxels(points[row], size) for row in members]
        x, y, z = zip(*exact, strict=True)
        means[cell] = [exact_mean(x), exact_mean(y), exact_mean(z)]
    return rows, means


def exact_mean(fractions):
    return sum(fractions) / len(fractions)


def cell_of(point, size):
    return tuple(floor(value / size) for value in point)


def squared_distance(point, mean, size):
    """Return the exact squared distance of a point to a mean, in voxels."""
    total = Fraction(0)
    for value, middle in zip(in_voxels(point, size), mean, strict=True):
        total += (value - middle) ** 2
    return total


@pytest.mark.parametrize("cloud", CLOUDS)
@pytest.mark.parametrize("size", [0.3, 0.75, 5.0])
def test_representatives_equal_plain_twin(cloud, size):
    points = CLOUDS[cloud]
    members, means = plain_voxels(points, size)

    rows = representatives(points, size).rows

    assert len(rows) == len(members)
    chosen = {cell_of(points[row], size): row for row in rows}
    assert chosen.keys() == members.keys()
    for cell, row in chosen.items():
        distances = {}
        for other in members[cell]:
            distances[other] = squared_distance(points[other], means[cell], size)
        nearest = float(min(distances.values()))
        assert float(distances[row]) <= nearest * (1 + 1e-6) + 1e-18


def test_representatives_tie_takes_lowest_coordinates():
    points = np.full((3, 3), 0.5)
    points[:, 0] = [0.75, 0.25, 0.25]

    rows = representatives(points, 1.0).rows

    assert rows.tolist() == [1]


def test_representatives_weight_takes_heaviest_then_nearest():
    points = np.array(
        [
            [0.5, 0.5, 0.5],
            [0.1, 0.1, 0.1],
            [0.6, 0.6, 0.6],
            [1.5, 0.5, 0.5],
        ]
    )
    weight = np.array([1.0, 2.0, 2.0, 0.5])

    rows = representatives(points, 1.0, weight=weight).rows

    assert rows.tolist() == [2, 3]


@pytest.mark.parametrize("cloud", CLOUDS)
def test_representatives_any_order_of_points_gives_the_same(cloud):
    points = CLOUDS[cloud]
    expected = representative_points(points)

    for seed in range(5):
        shuffled = np.random.default_rng(seed).permutation(points)
        assert representative_points(shuffled) == expected


def representative_points(points):
    rows = representatives(points, 0.3).rows
    return {tuple(point) for point in points[rows]}


@pytest.mark.parametrize("cloud", CLOUDS)
@pytest.mark.parametrize("part", [1, 7, 100])
def test_parts_merge_to_the_voxels_of_the_whole(cloud, part):
    points = CLOUDS[cloud]
    whole = occupied(points, 0.3)
    parts = [points[start : start + part] for start in range(0, len(points), part)]

    merged = occupied(parts[0], 0.3)
    for other in parts[1:]:
        merged = merged.merge(occupied(other, 0.3))

    for expected, actual in zip(whole, merged, strict=True):
        np.testing.assert_array_equal(actual, expected)


def test_means_are_exact_to_a_billionth_of_a_voxel():
    points = CLOUDS["map"]
    _, means = plain_voxels(points, 0.75)

    voxels = occupied(points, 0.75)

    expected = []
    for place in sorted(means):
        mean = [float(axis * Fraction(0.75)) for axis in means[place]]
        expected.append(mean)
    np.testing.assert_allclose(voxels.means(0.75), expected, rtol=0, atol=2e-9)


def test_many_voxels_are_counted():
    points = np.random.default_rng(1).uniform(-500, 500, (20_000, 3))

    voxels = occupied(points, 3.0)

    places, counts = np.unique(np.floor(points / 3.0), axis=0, return_counts=True)
    np.testing.assert_array_equal(voxels.places, places)
    np.testing.assert_array_equal(voxels.counts, counts)


def test_too_small_voxels_are_refused():
    points = np.array([[5e6, 0.0, 0.0]])

    with pytest.raises(UserError, match="voxel: 1e-12 is too small for coordinates of up to 5e"):
        occupied(points, 1e-12)


def test_more_points_in_a_voxel_than_their_sums_hold_are_refused(monkeypatch):
    monkeypatch.setattr(voxels, "MOST", 3)
    three = np.full((3, 3), 0.5)
    part = voxels.occupied(three, 1.0)

    with pytest.raises(UserError, match=r"voxel: 4 points share one\. Use voxels of up to 3 poi"):
        voxels.occupied(np.full((4, 3), 0.5), 1.0)
    with pytest.raises(UserError, match="voxel: 6 points share one"):
        part.merge(part)
