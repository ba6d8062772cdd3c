"""Tiles: cut, sampled, and thinned where they meet."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from mops_lightning.errors import UserError
from mops_lightning.samplers import tiles
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.random import RandomSampler
from mops_lightning.samplers.tiles import balanced_tiles, sample_by_tiles, shares, thin


def cloud(number, seed=0):
    unit = np.random.default_rng(seed).normal(size=(number, 3))
    return unit * [5, 2, 1] + np.array([400_000, 0, 0])


def street(number=4000):
    """A flat strip far from the origin, denser at one end."""
    random = np.random.default_rng(0)
    along = 40 * random.random(number) ** 2
    across = 4 * random.random(number)
    height = 0.1 * random.random(number)
    points = np.column_stack([along, across, height])
    return points + np.array([431_000, 5_412_000, 120])


@pytest.fixture(scope="module")
def sampler():
    torch.manual_seed(0)
    return FMOPSNet(64).eval()


@pytest.mark.parametrize(
    ("number", "size"),
    [
        (1000, 128),
        (1025, 128),
        (100, 128),
        (7, 2),
        (1, 2),
    ],
)
def test_balanced_tiles_partition_into_equal_parts(number, size):
    tiles = balanced_tiles(cloud(number), size)

    rows = np.concatenate(tiles)
    assert sorted(rows.tolist()) == list(range(number))
    sizes = [len(tile) for tile in tiles]
    assert max(sizes) <= size
    assert max(sizes) - min(sizes) <= 1
    assert len(tiles) == math.ceil(number / size)


def test_balanced_tiles_do_not_overlap():
    points = np.random.default_rng(0).uniform(size=(512, 3)) * [8, 1, 1]

    tiles = balanced_tiles(points, 64)

    ends = []
    for tile in tiles:
        along = points[tile, 0]
        ends.append((along.min(), along.max()))
    for (_, end), (start, _) in pairwise(sorted(ends)):
        assert end <= start


def test_balanced_tiles_cut_equal_points():
    points = np.ones((10, 3))

    tiles = balanced_tiles(points, 4)

    assert sorted(map(len, tiles)) == [3, 3, 4]


def test_shares_sum_to_m_in_proportion():
    sizes = np.random.default_rng(1).integers(1, 40, 50)
    total = int(sizes.sum())

    numbers = shares(333, sizes.tolist())
    all_numbers = shares(total, sizes.tolist())

    exact = sizes * 333 / total
    assert numbers.sum() == 333
    assert np.abs(numbers - exact).max() < 1
    assert all_numbers.tolist() == sizes.tolist()


@pytest.mark.parametrize(
    ("m", "rows"),
    [
        (8, [0, 1, 2, 3, 4, 5, 6, 7]),
        (7, [0, 1, 2, 4, 5, 6, 7]),
        (6, [0, 1, 2, 4, 5, 7]),
    ],
)
def test_thin_removes_one_of_the_nearest_two(m, rows):
    points = np.zeros((8, 3))
    points[:, 0] = [0, 1, 2, 2.1, 3, 4, 4.2, 5]

    assert thin(points, m).tolist() == rows


def test_thin_equals_plain_removal():
    points = cloud(200)
    left = list(range(200))
    for _ in range(50):
        points_left = points[left]
        distances = np.linalg.norm(points_left[:, None] - points_left, axis=2)
        distances[np.tril_indices(len(left))] = np.inf
        _, second = np.unravel_index(distances.argmin(), distances.shape)
        left.pop(int(second))

    rows = thin(points, 150)

    assert rows.tolist() == left


def test_thin_equal_points_leaves_m_with_all_others():
    equal = np.ones((60, 3))
    points = np.concatenate([equal, cloud(4)])

    rows = thin(points, 10).tolist()

    assert len(set(rows)) == 10
    assert rows[-4:] == [60, 61, 62, 63]


def test_thin_to_few_points_keeps_them_apart():
    points = cloud(200)

    kept = points[thin(points, 10)]

    distances, _ = cKDTree(kept).query(kept, k=[2])
    assert len(kept) == 10
    assert np.min(distances) > 3  # the nearest of ten random points are 1.3 apart on average


def test_thin_pairs_of_equal_points_leaves_one_of_each():
    points = np.repeat(cloud(20), 2, axis=0)

    rows = thin(points, 20)

    assert rows.tolist() == list(range(0, 40, 2))


def test_sample_by_tiles_returns_m_different_rows(sampler):
    points = street()
    for one in (sampler, FPSSampler(201), RandomSampler(201)):
        rows = sample_by_tiles(points, 256, 201, one)
        assert len(set(rows.tolist())) == 201
        assert rows.tolist() == sorted(rows)


def test_sample_by_tiles_keeps_seams_free():
    points = street()

    rows = sample_by_tiles(points, 256, 400, FPSSampler(400))

    kept = points[rows]
    distances, _ = cKDTree(kept).query(kept, k=[2])
    assert np.min(distances) > 0.4 * np.median(distances)


def test_sample_by_tiles_keeps_points_in_proportion():
    points = street()
    is_near = points[:, 0] < 431_010

    rows = sample_by_tiles(points, 256, 400, RandomSampler(400))

    share = is_near[rows].mean()
    assert share == pytest.approx(is_near.mean(), abs=0.03)


def test_sample_by_tiles_samples_every_tile_as_the_sampler_does(sampler):
    points = street(512)
    for one in (sampler, FPSSampler(64)):
        expected: set[int] = set()
        for tile in balanced_tiles(points, 256):
            given = points[tile]
            if not one.any_unit:
                centred = given - given.mean(0)
                radius = np.linalg.norm(centred, axis=1).max()
                given = (centred / radius).astype(np.float32)
            clouds = torch.from_numpy(given[None])
            selected: Any = one.select("completed", clouds, 40)
            _, (rows,) = selected
            expected.update(tile[rows.numpy()])

        sampled = sample_by_tiles(points, 256, 64, one)

        assert expected.issuperset(sampled)


class Recording(FPSSampler):
    """Notes how many points of how many tiles are asked for."""

    def __init__(self, m):
        super().__init__(m)
        self.asked = []

    def choose_rows(self, points, m, weight=None):
        self.asked.append((*points.shape[:2], m))
        return super().choose_rows(points, m, weight)


@pytest.mark.parametrize(
    ("size", "asked"),
    [
        (250, (2, 250, 50)),  # a quarter more than 80 points
        (500, (1, 500, 80)),  # one tile has no seams
    ],
)
def test_sample_by_tiles_samples_a_quarter_more_points_than_it_keeps(size, asked):
    sampler = Recording(400)

    rows = sample_by_tiles(street(500), size, 80, sampler)

    assert sampler.asked == [asked]
    assert len(rows) == 80


class Noting(FPSSampler):
    """Notes the tiles that it gets."""

    def __init__(self, m):
        super().__init__(m)
        self.tiles = []

    def select(self, readout, clouds, m, weight=None):
        self.tiles += clouds
        return super().select(readout, clouds, m, weight)


def test_sample_by_tiles_gives_every_tile_its_own_channels():
    points = street(500)
    channels = torch.from_numpy(points[:, :2] / 1000)
    sampler = Noting(400)

    sample_by_tiles(points, 125, 80, sampler, channels)

    assert len(sampler.tiles) == 4
    for tile in sampler.tiles:
        assert torch.equal(tile[:, 3:], tile[:, :2] / 1000)


def test_sample_by_tiles_in_several_batches_keeps_the_same_rows(sampler, monkeypatch):
    points = street(1000)
    together = sample_by_tiles(points, 100, 200, sampler)

    monkeypatch.setattr(tiles, "BATCH", 300)

    assert sample_by_tiles(points, 100, 200, sampler).tolist() == together.tolist()


def test_sample_by_tiles_all_points_and_too_many(sampler):
    points = street(500)

    every_row = sample_by_tiles(points, 60, 500, sampler)
    most_rows = sample_by_tiles(points, 250, 128, sampler)

    assert every_row.tolist() == list(range(500))
    assert len(most_rows) == 128
    with pytest.raises(UserError, match=r"2 tiles of up to 250 points .* up to 64 points of each"):
        sample_by_tiles(points, 250, 129, sampler)
