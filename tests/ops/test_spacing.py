"""Subsets of a smallest distance beside a plain twin of O(N²)."""

import numpy as np
import pytest

from mops_lightning.ops.spacing import keep_spaced, priorities, priority_order, uncovered

RNG = np.random.default_rng(0)
CLOUDS = {
    "random": RNG.normal(size=(400, 3)),
    "ties": RNG.integers(-3, 4, (300, 3)) * 0.25,
    "copies": np.repeat(RNG.normal(size=(60, 3)), 4, axis=0),
    "map": RNG.uniform(0, 3, (300, 3)) + np.array([512_345.678901, 5_412_345.678901, 312.5]),
    "five columns": RNG.normal(size=(300, 5)),
    "line": RNG.normal(size=(300, 1)),
    "one": np.array([[1.0, -2.0, 3.0]]),
}


def squared_distances(points):
    return sum((axis[:, None] - axis[None]) ** 2 for axis in points.T)


def plain_spaced(points, spacing, order):
    squared = squared_distances(points)
    kept: list[int] = []
    for row in order:
        if all(squared[row, other] >= spacing * spacing for other in kept):
            kept.append(row)
    return sorted(kept)


@pytest.mark.parametrize("cloud", CLOUDS)
@pytest.mark.parametrize("spacing", [0.25, 0.6, 20.0])
def test_keep_spaced_equals_plain_twin(cloud, spacing):
    points = CLOUDS[cloud]
    keys = priorities(points)
    order = sorted(range(len(points)), key=lambda row: (keys[row], *points[row], row))

    assert keep_spaced(points, spacing).tolist() == plain_spaced(points, spacing, order)


@pytest.mark.parametrize("cloud", CLOUDS)
@pytest.mark.parametrize("spacing", [0.25, 0.6])
def test_keep_spaced_is_spaced_and_covers(cloud, spacing):
    points = CLOUDS[cloud]
    kept = keep_spaced(points, spacing)

    distances = np.sqrt(squared_distances(points))

    between = distances[np.ix_(kept, kept)] + np.diag(np.full(len(kept), np.inf))
    assert between.min() >= spacing * (1 - 1e-15)
    assert distances[:, kept].min(1).max() < spacing


@pytest.mark.parametrize(("spacing", "number"), [(1e-300, 2), (1e300, 1)])
def test_keep_spaced_square_of_spacing_beyond_float64(spacing, number):
    points = np.array(
        [
            [0.0, 0.0, 0.0],
            [5.0, 0.0, 0.0],
            [0.0, 0.0, 0.0],
        ]
    )

    kept = keep_spaced(points, spacing)

    different = np.unique(points[kept], axis=0)
    assert len(kept) == number
    assert len(different) == number


@pytest.mark.parametrize("cloud", CLOUDS)
def test_keep_spaced_any_order_of_points_gives_the_same(cloud):
    points = CLOUDS[cloud]
    expected = {tuple(point) for point in points[keep_spaced(points, 0.4)]}

    for seed in range(5):
        shuffled = np.random.default_rng(seed).permutation(points)
        assert {tuple(point) for point in shuffled[keep_spaced(shuffled, 0.4)]} == expected


def test_keep_spaced_seed_gives_another_subset():
    points = CLOUDS["random"]

    assert keep_spaced(points, 0.4, seed=1).tolist() != keep_spaced(points, 0.4).tolist()


def test_keep_spaced_of_copies_keeps_the_first_row():
    points = np.array([[1.0, 2.0, 3.0], [5.0, 5.0, 5.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]])

    assert keep_spaced(points, 0.5).tolist() == [0, 1]


@pytest.mark.parametrize(
    ("weight", "expected"),
    [
        ([1.0, 2.0, 1.0], [1]),
        ([2.0, 1.0, 2.0], [0, 2]),
    ],
)
def test_keep_spaced_prefers_heavy_points(weight, expected):
    points = np.array(
        [
            [0.0, 0.0, 0.0],
            [0.1, 0.0, 0.0],
            [0.2, 0.0, 0.0],
        ]
    )

    kept = keep_spaced(points, 0.15, weight=np.array(weight))

    assert kept.tolist() == expected


def test_priority_order_equal_hashes_are_ordered_by_coordinates_then_rows():
    points = np.array(
        [
            [3.0, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [2.0, 0.0, 0.0],
            [1.0, 0.0, 0.0],
        ]
    )
    hashes = np.array([7, 7, 5, 7], np.uint64)

    order = priority_order(points, hashes)

    assert order.tolist() == [2, 1, 3, 0]


def test_priorities_of_zeros_do_not_depend_on_the_sign():
    keys = priorities(np.array([[0.0, 1.0, 2.0], [-0.0, 1.0, 2.0]]))

    assert keys[0] == keys[1]


def test_uncovered_returns_points_without_a_near_kept_point():
    points = CLOUDS["random"]
    kept = points[keep_spaced(points[:40], 0.7)]

    rows = uncovered(points, kept, 0.7)

    distances = np.linalg.norm(points[:, None] - kept[None], axis=2).min(1)
    assert rows.tolist() == np.flatnonzero(distances >= 0.7).tolist()


def test_uncovered_of_nothing_kept_returns_all():
    assert uncovered(CLOUDS["one"], np.empty((0, 3)), 0.7).tolist() == [0]
