import struct

import numpy as np
import torch

from mops_lightning.samplers.ordering import (
    FIRST,
    SECOND,
    STEP,
    compiled_hashes,
    point_hashes,
    seeded_order,
)

WORD = 2**64


def plain_hashes(cloud, seed):
    """The same hash with unbounded integers."""

    def fold(key, shift):
        return key ^ (key >> shift)

    keys = []
    for point in cloud.tolist():
        key = (seed * STEP + 1) % WORD
        for coordinate in point:
            (bits,) = struct.unpack("<Q", struct.pack("<d", coordinate + 0.0))
            key = fold((key ^ bits) * FIRST % WORD, 32)
        keys.append(key)
    whole = sum(fold(key, 29) * SECOND for key in keys) % WORD
    result = []
    for key in keys:
        key = fold((key + whole) % WORD, 30) * FIRST % WORD
        result.append(fold(fold(key, 27) * SECOND % WORD, 31))
    return result


def test_point_hashes_equal_plain_form(randn):
    points = randn(2, 40, 3)
    points[0, :9, 1] = -0.0  # equal to 0
    for seed in (0, 7, -3, 2**63):
        hashes = point_hashes(points, seed)
        for cloud, row in zip(points, hashes.tolist(), strict=True):
            assert [key % WORD for key in row] == plain_hashes(cloud, seed)
        assert torch.equal(point_hashes(points.double(), seed), hashes)
        compiled = compiled_hashes(points, seed).view(np.int64)
        assert torch.equal(torch.from_numpy(compiled), hashes)
        assert torch.equal(seeded_order(points, seed), hashes.argsort(1))
