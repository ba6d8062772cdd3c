import struct

import torch

from mops_lightning.samplers.ordering import FIRST, SECOND, STEP, point_hashes, seeded_order

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


def test_point_hashes_equal_plain_form(rng):
    points = torch.randn(2, 40, 3, generator=rng)
    for seed in (0, 7, -3, 2**63):
        hashes = point_hashes(points, seed).tolist()
        for cloud, row in zip(points, hashes, strict=True):
            assert [key % WORD for key in row] == plain_hashes(cloud, seed)


def test_seeded_order_is_independent_of_input_order_and_dtype(rng):
    points = torch.randn(2, 30, 3, generator=rng)
    permuted = points[:, torch.randperm(30, generator=rng)]
    for b in range(2):
        first = points[b][seeded_order(points, 4)[b]]
        assert torch.equal(permuted[b][seeded_order(permuted, 4)[b]], first)
    assert torch.equal(seeded_order(points.double(), 4), seeded_order(points, 4))


def test_seeded_order_ignores_sign_of_zero(rng):
    points = torch.randn(1, 30, 3, generator=rng)
    points[..., 1] = 0.0
    mirrored = points * torch.tensor([1.0, -1.0, 1.0])
    assert torch.equal(seeded_order(mirrored, 0), seeded_order(points, 0))
