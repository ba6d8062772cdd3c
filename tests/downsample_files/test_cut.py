from itertools import pairwise

import numpy as np
import pytest

from mops_lightning.downsample_files.cut import Tiling, balanced_tiles, cubes
from mops_lightning.errors import UserError


def cloud(number, seed=0):
    return np.random.default_rng(seed).normal(size=(number, 3)) * [5, 2, 1] + [400_000, 0, 0]


@pytest.mark.parametrize(("number", "size"), [(1000, 128), (1025, 128), (100, 128), (7, 2), (1, 2)])
def test_balanced_tiles_partition_into_equal_parts(number, size):
    tiles = balanced_tiles(cloud(number), size)
    assert sorted(np.concatenate(tiles).tolist()) == list(range(number))
    sizes = [len(tile) for tile in tiles]
    assert max(sizes) <= size
    assert max(sizes) - min(sizes) <= 1
    assert len(tiles) == -(-number // size)


def test_balanced_tiles_do_not_overlap():
    points = np.random.default_rng(0).uniform(size=(512, 3)) * [8, 1, 1]
    ends = sorted(
        (points[tile, 0].min(), points[tile, 0].max()) for tile in balanced_tiles(points, 64)
    )
    assert all(first[1] <= second[0] for first, second in pairwise(ends))


def test_balanced_tiles_equal_points_are_cut():
    assert sorted(map(len, balanced_tiles(np.ones((10, 3)), 4))) == [3, 3, 4]


def test_cubes_hold_what_is_inside():
    points = cloud(500)
    origin = points.min(0)
    tiles = cubes(points, 1.5, origin)
    assert sorted(np.concatenate(tiles).tolist()) == list(range(500))
    position = [np.unique(np.floor((points[tile] - origin) / 1.5), axis=0) for tile in tiles]
    assert all(len(one) == 1 for one in position)
    assert len(np.unique(np.concatenate(position), axis=0)) == len(tiles)


def test_cubes_too_small_raises():
    with pytest.raises(UserError, match=r"--tile-size 1e-06 .* cubes along an axis"):
        cubes(cloud(50), 1e-6, cloud(50).min(0))


def test_shares_sum_to_m_in_any_parts():
    sizes = np.random.default_rng(1).integers(1, 40, 50).tolist()
    tiling = Tiling(sum(sizes), 333, 40, None, np.zeros(3))
    shares = tiling.shares(0, sizes)
    assert shares.sum() == 333
    exact = np.array(sizes) * 333 / sum(sizes)
    assert np.abs(shares - exact).max() < 1
    parts = [tiling.shares(0, sizes[:20]), tiling.shares(sum(sizes[:20]), sizes[20:])]
    assert np.concatenate(parts).tolist() == shares.tolist()
    everything = tiling._replace(m=sum(sizes))
    assert everything.shares(0, sizes).tolist() == sizes
