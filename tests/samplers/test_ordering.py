import struct

import pytest
import torch

from mops_lightning.samplers.ordering import (
    FIRST,
    SECOND,
    STEP,
    point_hashes,
    seeded_hashes,
    seeded_order,
)

WORD = 2**64


def plain_hashes(cloud, seed):
    """The same hash with unbounded integers."""

    keys = []
    for point in cloud.tolist():
        key = (seed * STEP + 1) % WORD
        for coordinate in point:
            key ^= bits_of(coordinate + 0.0)
            key = key * FIRST % WORD
            key = folded(key, 32)
        keys.append(key)
    words = [folded(key, 29) * SECOND for key in keys]
    of_cloud = sum(words) % WORD
    return [scrambled((key + of_cloud) % WORD) for key in keys]


def bits_of(number):
    """Return the bits of a float64 as a whole number."""
    (bits,) = struct.unpack("<Q", struct.pack("<d", number))
    return bits


def folded(key, shift):
    return key ^ (key >> shift)


def scrambled(key):
    key = folded(key, 30) * FIRST % WORD
    key = folded(key, 27) * SECOND % WORD
    return folded(key, 31)


SEEDS = (0, 7, -3, 2**63)


@pytest.fixture
def points(randn):
    clouds = randn(2, 40, 3)
    clouds[0, :9, 1] = -0.0  # equal to 0
    return clouds


@pytest.mark.parametrize("seed", SEEDS)
def test_point_hashes_equal_plain_form(seed, points):
    hashes = point_hashes(points, seed)

    for cloud, row in zip(points, hashes.tolist(), strict=True):
        unsigned = [key % WORD for key in row]
        assert unsigned == plain_hashes(cloud, seed)


@pytest.mark.parametrize("seed", SEEDS)
def test_point_hashes_of_both_precisions_and_of_loops_are_equal(seed, points):
    hashes = point_hashes(points, seed)

    of_double = point_hashes(points.double(), seed)
    compiled = seeded_hashes(points, seed)

    assert torch.equal(of_double, hashes)
    assert torch.equal(compiled, hashes)


@pytest.mark.parametrize("seed", SEEDS)
def test_seeded_order_is_that_of_the_hashes(seed, points):
    order = seeded_order(points, seed)

    hashes = point_hashes(points, seed)
    assert torch.equal(order, hashes.argsort(1))
