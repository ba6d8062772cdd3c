import struct
from collections import Counter
from itertools import permutations

import torch
from scipy.special import chdtrc

from mops_lightning.samplers.ordering import FIRST, SECOND, STEP, point_hashes, seeded_order
from mops_lightning.samplers.random import RandomSampler

WORD = 2**64


def chi_square_p(counts, expected, share):
    """P-value of counts that should be equal, each event drawing this share of the cells."""
    statistic = sum((c - expected) ** 2 for c in counts) / (expected * (1 - share))
    freedom = len(counts) - 1
    return chdtrc(freedom, statistic * freedom / len(counts))


def plain_hashes(cloud, seed):
    """The same hash in unbounded integers."""

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


def test_hash_equals_its_twin_in_unbounded_integers(rng):
    points = torch.randn(2, 40, 3, generator=rng)
    for seed in (0, 7, -3, 2**63):
        hashes = point_hashes(points, seed).tolist()
        for cloud, row in zip(points, hashes, strict=True):
            assert [key % WORD for key in row] == plain_hashes(cloud, seed)


def test_every_place_is_chosen_equally_often(rng):
    """Over clouds: neither points on one side nor points near the centre are preferred."""
    points = torch.randn(4000, 50, 3, generator=rng)
    indices = RandomSampler(10)(points).indices
    for value in (points[..., 0], points.norm(dim=2)):
        rank = value.argsort(1).argsort(1).gather(1, indices)
        counts = rank.flatten().bincount(minlength=50).tolist()
        assert chi_square_p(counts, 4000 * 10 / 50, 10 / 50) > 1e-3


def test_every_point_is_chosen_equally_often_over_seeds(rng):
    points = torch.randn(1, 50, 3, generator=rng)
    counts: Counter[int] = Counter()
    for seed in range(1000):
        counts.update(RandomSampler(10, seed)(points).indices[0].tolist())
    assert chi_square_p(counts.values(), 1000 * 10 / 50, 10 / 50) > 1e-3


def test_every_pair_is_equally_likely_in_either_order(rng):
    points = torch.randint(0, 3, (1, 5, 3), generator=rng) / 4  # few bits to hash
    points[..., 0] += torch.arange(5)
    pairs: Counter[tuple[int, ...]] = Counter()
    for seed in range(1500):
        pairs[tuple(RandomSampler(2, seed)(points).indices[0].tolist())] += 1
    counts = [pairs[pair] for pair in permutations(range(5), 2)]
    assert chi_square_p(counts, 1500 / 20, 1 / 20) > 1e-3


def test_a_point_that_all_clouds_share_is_not_chosen_in_all_or_none(rng):
    points = torch.randn(4000, 20, 3, generator=rng)
    points[:, 0] = 0.0
    share = (RandomSampler(5)(points).indices == 0).any(1).float().mean()
    assert abs(share - 5 / 20) < 0.03


def test_smaller_samples_are_the_first_points_of_larger_ones(rng):
    points = torch.randn(2, 30, 3, generator=rng)
    sampler = RandomSampler(20)
    assert torch.equal(sampler(points, 5).indices, sampler(points).indices[:, :5])


def test_order_is_that_of_the_points_not_of_their_places_or_type(rng):
    points = torch.randn(2, 30, 3, generator=rng)
    permuted = points[:, torch.randperm(30, generator=rng)]
    for b in range(2):
        first = points[b][seeded_order(points, 4)[b]]
        assert torch.equal(permuted[b][seeded_order(permuted, 4)[b]], first)
    assert torch.equal(seeded_order(points.double(), 4), seeded_order(points, 4))


def test_zero_has_no_sign(rng):
    points = torch.randn(1, 30, 3, generator=rng)
    points[..., 1] = 0.0
    mirrored = points * torch.tensor([1.0, -1.0, 1.0])
    assert torch.equal(seeded_order(mirrored, 0), seeded_order(points, 0))


def test_copies_of_a_point_are_chosen_independently(rng):
    """Of 200 points given twice, 100 draws hit about 88 different ones: not 50, not 100."""
    points = torch.randn(20, 200, 3, generator=rng).repeat(1, 2, 1)
    indices = RandomSampler(100)(points).indices % 200
    different = torch.tensor([len(set(row)) for row in indices.tolist()], dtype=torch.float32)
    # Each point is missed by both copies with chance (300·299)/(400·399).
    expected = 200 * (1 - 300 * 299 / (400 * 399))
    assert abs(different.mean() - expected) < 2.5
