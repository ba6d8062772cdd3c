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
    return np.random.default_rng(0).uniform(0, side, (number, 3)) + FAR


def cut(points, n_points):
    return random_crops(points, n_points, None, "tiles", np.random.default_rng(0), PATH)


def draw(points, crop="nearest", n_points=50, number=6, seed=1):
    rng = np.random.default_rng(seed)
    return random_crops(points, n_points, number, crop, rng, PATH).points


def test_random_crops_nearest_is_a_ball_around_a_point():
    points = cloud()

    crops = draw(points)

    assert crops.shape == (6, 50, 3)
    assert np.abs(crops.mean(1)).max() < 1e-5
    centre = points[np.random.default_rng(1).integers(len(points))]
    distances = np.linalg.norm(points - centre, axis=1)
    radius = np.sort(distances)[49]
    near = points[distances <= radius]
    assert np.allclose(crops[0], near - near.mean(0), atol=1e-5)


def test_random_crops_whole():
    points = cloud()

    whole = draw(points, "whole", n_points=1000, number=2)

    assert np.ptp(whole, axis=1).min() > 9
    assert not np.array_equal(whole[0], whole[1])
    assert len(np.unique(whole[0], axis=0)) == 1000


def test_random_crops_of_coincident_points_raises():
    with pytest.raises(BadCloudError, match="the 50 points of a crop coincide"):
        draw(np.ones((60, 3)), "whole")


def test_tiles_have_every_point_as_their_own_once():
    unit = uniform_points(1000, 0)
    points = unit * [100, 60, 5] + 5e5

    tiles = cut(points, 96)

    assert tiles.own is not None
    assert tiles.points.shape == (11, 96, 3)
    own_rows = tiles.rows[tiles.own]
    assert np.sort(own_rows).tolist() == list(range(1000))
    assert abs(tiles.points.mean(1)).max() < 1e-4


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
        radius = np.linalg.norm(own - middle, axis=1).max()
        reach = np.linalg.norm(others - middle, axis=1).max()
        assert reach < 1.5 * radius


def test_tiles_of_as_many_points_as_a_tile_are_the_whole_cloud():
    points = uniform_points(50, 0)

    tiles = cut(points, 50)

    assert tiles.own is not None
    assert tiles.own.all()
    assert tiles.rows.tolist() == [list(range(50))]
