"""Tiles: cut, sampled, and thinned where they meet."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from mops_lightning.errors import UserError
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.random import RandomSampler
from mops_lightning.samplers.tiles import balanced_tiles, sample_by_tiles, shares, thin


def cloud(number, seed=0):
    return np.random.default_rng(seed).normal(size=(number, 3)) * [5, 2, 1] + [400_000, 0, 0]


def street(number=4000):
    """A flat strip far from the origin, denser at one end."""
    random = np.random.default_rng(0)
    along = 40 * random.random(number) ** 2
    points = np.stack([along, 4 * random.random(number), 0.1 * random.random(number)], 1)
    return points + np.array([431_000, 5_412_000, 120])


@pytest.fixture(scope="module")
def sampler():
    torch.manual_seed(0)
    return FMOPSNet(64).eval()


@pytest.mark.parametrize(("number", "size"), [(1000, 128), (1025, 128), (100, 128), (7, 2), (1, 2)])
def test_balanced_tiles_partition_into_equal_parts(number, size):
    tiles = balanced_tiles(cloud(number), size)
    assert sorted(np.concatenate(tiles).tolist()) == list(range(number))
    sizes = [len(tile) for tile in tiles]
    assert max(sizes) <= size
    assert max(sizes) - min(sizes) <= 1
    assert len(tiles) == -(-number // size)


def test_balanced_tiles_do_not_overlap_and_cut_equal_points():
    points = np.random.default_rng(0).uniform(size=(512, 3)) * [8, 1, 1]
    ends = sorted(
        (points[tile, 0].min(), points[tile, 0].max()) for tile in balanced_tiles(points, 64)
    )
    assert all(first[1] <= second[0] for first, second in pairwise(ends))
    assert sorted(map(len, balanced_tiles(np.ones((10, 3)), 4))) == [3, 3, 4]


def test_shares_sum_to_m_in_proportion():
    sizes = np.random.default_rng(1).integers(1, 40, 50).tolist()
    numbers = shares(333, sizes)
    assert numbers.sum() == 333
    assert np.abs(numbers - np.array(sizes) * 333 / sum(sizes)).max() < 1
    assert shares(sum(sizes), sizes).tolist() == sizes


def test_thin_removes_one_of_the_nearest_two():
    points = np.array([0, 1, 2, 2.1, 3, 4, 4.2, 5])[:, None] * [1.0, 0, 0]
    assert thin(points, 8).tolist() == list(range(8))
    assert thin(points, 7).tolist() == [0, 1, 2, 4, 5, 6, 7]
    assert thin(points, 6).tolist() == [0, 1, 2, 4, 5, 7]


def test_thin_equals_plain_removal():
    points = cloud(200)
    remains = list(range(200))
    for _ in range(50):
        distance = np.linalg.norm(points[remains][:, None] - points[remains], axis=2)
        distance[np.tril_indices(len(remains))] = np.inf
        remains.pop(int(np.unravel_index(distance.argmin(), distance.shape)[1]))
    assert thin(points, 150).tolist() == remains


def test_thin_equal_points_leaves_m():
    points = np.concatenate([np.ones((60, 3)), cloud(4)])
    rows = thin(points, 10)
    assert len(set(rows.tolist())) == 10


def test_sample_by_tiles_returns_m_different_rows(sampler):
    points = street()
    for one in (sampler, FPSSampler(201), RandomSampler(201)):
        rows = sample_by_tiles(points, 256, 201, one)
        assert len(set(rows.tolist())) == 201
        assert rows.tolist() == sorted(rows)


def test_sample_by_tiles_keeps_seams_free():
    points = street()
    kept = points[sample_by_tiles(points, 256, 400, FPSSampler(400))]
    nearest = np.asarray(cKDTree(kept).query(kept, k=2)[0])[:, 1]
    assert nearest.min() > 0.4 * np.median(nearest)


def test_sample_by_tiles_keeps_points_in_proportion():
    points = street()
    kept = points[sample_by_tiles(points, 256, 400, RandomSampler(400))]
    near = (points[:, 0] < 431_010).mean()
    assert abs((kept[:, 0] < 431_010).mean() - near) < 0.03


def test_sample_by_tiles_samples_every_tile_as_the_sampler_does(sampler):
    points = street(512)
    for one in (sampler, FPSSampler(64)):
        expected: set[int] = set()
        for tile in balanced_tiles(points, 256):
            centred = points[tile] - points[tile].mean(0)
            sphere = torch.from_numpy(centred / np.linalg.norm(centred, axis=1).max()).float()
            given = torch.from_numpy(points[tile]) if one.any_unit else sphere
            rows: Any = one.select("completed", given[None], 40)[1]
            expected.update(tile[rows[0].numpy()])
        assert expected.issuperset(sample_by_tiles(points, 256, 64, one))


def test_sample_by_tiles_all_points_and_too_many(sampler):
    points = street(500)
    assert sample_by_tiles(points, 60, 500, sampler).tolist() == list(range(500))
    assert len(sample_by_tiles(points, 250, 128, sampler)) == 128
    with pytest.raises(UserError, match=r"2 tiles of up to 250 points .* up to 64 points of each"):
        sample_by_tiles(points, 250, 129, sampler)
