"""Crops of clouds."""

from pathlib import Path

import numpy as np
import pytest

from mops_lightning.data.crops import random_crops
from mops_lightning.data.formats.guard import BadCloudError
from tests.support.clouds import uniform_points

PATH = Path("scan.ply")
FAR = np.array([431_000.0, 5_412_000.0, 120.0])


def cloud(number=2000, side=10.0):
    return side * uniform_points(number, 0) + FAR


def cut(points, n_points):
    rng = np.random.default_rng(0)
    return random_crops(points, n_points, None, "tiles", rng, PATH)


def draw(points, crop="nearest", n_points=50, number=6, seed=1):
    rng = np.random.default_rng(seed)
    return random_crops(points, n_points, number, crop, rng, PATH).points


def test_random_crops_nearest_is_a_ball_around_a_point():
    points = cloud()

    crops = draw(points)

    means = crops.mean(1)
    assert crops.shape == (6, 50, 3)
    assert np.abs(means).max() < 1e-5
    row_of_centre = np.random.default_rng(1).integers(len(points))
    distances = np.linalg.norm(points - points[row_of_centre], axis=1)
    radius = np.sort(distances)[49]
    near = points[distances <= radius]
    expected = near - near.mean(0)
    assert np.allclose(crops[0], expected, atol=1e-5)


def test_random_crops_whole():
    points = cloud()

    first, second = draw(points, "whole", n_points=1000, number=2)

    different_points = np.unique(first, axis=0)
    assert np.ptp(first, axis=0).min() > 9
    assert np.ptp(second, axis=0).min() > 9
    assert not np.array_equal(first, second)
    assert len(different_points) == 1000


def test_random_crops_of_coincident_points_raises():
    points = np.ones((60, 3))

    with pytest.raises(BadCloudError, match="the 50 points of a crop coincide"):
        draw(points, "whole")


def test_random_crops_are_drawn_again_where_the_points_of_one_coincide():
    """Nine tenths of the points are copies of one; the others differ in z alone."""
    points = np.ones((1000, 3))
    points[900:, 2] = np.arange(100)

    crops = draw(points, "nearest", n_points=2, number=3)

    for crop in crops:
        assert crop[0, 2] != crop[1, 2]


def test_random_crops_of_as_many_points_as_the_cloud_has_are_the_cloud():
    points = cloud(50)

    (nearest,) = draw(points, n_points=50, number=1)
    (whole,) = draw(points, "whole", n_points=50, number=1)

    expected = points - points.mean(0)
    sorted_whole = np.sort(whole, axis=0)
    sorted_expected = np.sort(expected, axis=0)
    assert np.allclose(nearest, expected, atol=1e-5)
    assert np.allclose(sorted_whole, sorted_expected, atol=1e-5)
    with pytest.raises(BadCloudError, match=r"scan\.ply has 50 points, fewer than .*n_points=51"):
        draw(points, n_points=51, number=1)


def test_tiles_have_every_point_as_their_own_once():
    unit = uniform_points(1000, 0)
    points = unit * [100, 60, 5] + 5e5

    tiles = cut(points, 96)

    assert tiles.own is not None
    assert tiles.points.shape == (11, 96, 3)
    own_rows = tiles.rows[tiles.own]
    means = tiles.points.mean(1)
    assert np.sort(own_rows).tolist() == list(range(1000))
    assert abs(means).max() < 1e-4


def test_tiles_are_filled_up_by_near_points_of_other_tiles():
    unit = uniform_points(1000, 0)
    points = unit * [100, 60, 5]

    tiles = cut(points, 96)

    assert tiles.own is not None
    for rows, is_own in zip(tiles.rows, tiles.own, strict=True):
        assert len(np.unique(rows)) == 96
        own = points[rows[is_own]]
        others = points[rows[~is_own]]
        middle = own.mean(0)
        distances = np.linalg.norm(points - middle, axis=1)
        distances[rows[is_own]] = np.inf
        nearest_others = np.sort(distances)[: len(others)]
        distances_of_others = np.linalg.norm(others - middle, axis=1)
        np.testing.assert_allclose(distances_of_others, nearest_others)


def test_tiles_of_as_many_points_as_a_tile_are_the_whole_cloud():
    points = uniform_points(50, 0)

    tiles = cut(points, 50)

    assert tiles.own is not None
    assert tiles.own.all()
    assert tiles.rows.tolist() == [list(range(50))]


def test_random_crops_whole_is_in_random_order():
    points = cloud(50)
    rng = np.random.default_rng(0)

    rows = random_crops(points, None, 1, "whole", rng, PATH).rows[0].tolist()

    assert sorted(rows) == list(range(50))
    assert rows != sorted(rows)
