import numpy as np
import pytest
from scipy.spatial import cKDTree

from mops_lightning.downsample_files.seams import Chosen, close_pairs, farthest_rows, to_drop


def line(*tiles):
    """Points on a line, given as the coordinates of every tile."""
    x = np.concatenate([np.asarray(tile, float) for tile in tiles])
    points = np.stack([x, 0 * x, 0 * x], 1)
    tile = np.repeat(np.arange(len(tiles)) * 100, [len(one) for one in tiles])
    place = np.arange(len(x))
    return Chosen(place, place, tile, points)


def test_close_pairs_only_across_tiles():
    chosen = line([0, 1, 2, 3, 3.9], [4, 5, 6, 7])
    assert close_pairs(chosen).tolist() == [[4, 5]]
    chosen = line([0, 1, 2, 3, 3.1], [4, 5, 6, 7])  # near, but of one tile
    assert close_pairs(chosen).tolist() == []


@pytest.mark.parametrize("spacing", [0.1, 100.0])
def test_close_pairs_use_the_local_spacing(spacing):
    def pairs(gap):
        first = spacing * np.arange(10)
        far = 1e4 + np.arange(0, 500, 50.0)  # of another spacing
        return close_pairs(line(first, first[-1] + gap * spacing + first, far)).tolist()

    assert pairs(0.6) == []
    assert pairs(0.4) == [[9, 10]]


def test_close_pairs_of_single_points():
    assert close_pairs(line([0.0], [0.1])).tolist() == []
    assert close_pairs(line([0.0])).tolist() == []


def test_to_drop_leaves_one_of_every_pair():
    pairs = np.array([[0, 1], [1, 2], [2, 3], [5, 9]])
    assert to_drop(pairs).tolist() == [1, 3, 9]


def test_farthest_rows_equal_plain_farthest_points():
    points = np.random.default_rng(0).normal(size=(60, 3))
    around = np.random.default_rng(1).normal(size=(9, 3))
    around = np.concatenate([around, points[[4, 8]]])
    rows = farthest_rows(points, 5, np.array([4, 8]), cKDTree(around))
    expected, kept = [], list(around)
    for _ in range(5):
        distance = np.linalg.norm(points[:, None] - np.array(kept), axis=2).min(1)
        expected.append(int(distance.argmax()))
        kept.append(points[expected[-1]])
    assert rows.tolist() == expected


def test_farthest_rows_equal_points_give_different_rows():
    rows = farthest_rows(np.ones((6, 3)), 4, np.array([0, 2]), cKDTree(np.ones((2, 3))))
    assert sorted(rows.tolist()) == [1, 3, 4, 5]
