from collections import Counter
from itertools import permutations

import torch
from scipy.special import chdtrc

from mops_lightning.samplers.random import RandomSampler


def chi_square_p(counts, expected, share):
    """Return the p-value of equal counts, where each event draws this share of the cells."""
    statistic = sum((c - expected) ** 2 for c in counts) / (expected * (1 - share))
    freedom = len(counts) - 1
    return chdtrc(freedom, statistic * freedom / len(counts))


def test_random_places_are_uniform(rng):
    """Neither points on one side of a cloud nor points near its centre are preferred."""
    points = torch.randn(4000, 50, 3, generator=rng)
    indices = RandomSampler(10)(points).indices
    for value in (points[..., 0], points.norm(dim=2)):
        rank = value.argsort(1).argsort(1).gather(1, indices)
        counts = rank.flatten().bincount(minlength=50).tolist()
        assert chi_square_p(counts, 4000 * 10 / 50, 10 / 50) > 1e-3


def test_random_pairs_are_uniform(rng):
    points = torch.randint(0, 3, (1, 5, 3), generator=rng) / 4  # few bits to hash
    points[..., 0] += torch.arange(5)
    pairs: Counter[tuple[int, ...]] = Counter()
    for seed in range(1500):
        pairs[tuple(RandomSampler(2, seed)(points).indices[0].tolist())] += 1
    counts = [pairs[pair] for pair in permutations(range(5), 2)]
    assert chi_square_p(counts, 1500 / 20, 1 / 20) > 1e-3


def test_random_shared_point_is_chosen_independently(rng):
    points = torch.randn(4000, 20, 3, generator=rng)
    points[:, 0] = 0.0
    share = (RandomSampler(5)(points).indices == 0).any(1).float().mean()
    assert abs(share - 5 / 20) < 0.03


def test_random_copies_are_chosen_independently(rng):
    """100 draws from 200 points with two copies each give about 88 distinct points."""
    points = torch.randn(20, 200, 3, generator=rng).repeat(1, 2, 1)
    indices = RandomSampler(100)(points).indices % 200
    different = torch.tensor([len(set(row)) for row in indices.tolist()], dtype=torch.float32)
    # Neither copy of a point is drawn with probability (300·299)/(400·399).
    expected = 200 * (1 - 300 * 299 / (400 * 399))
    assert abs(different.mean() - expected) < 2.5


def test_random_by_weight_equals_successive_draws():
    """The probability of a pair is the product of two draws in proportion to the weights."""
    points, weight = torch.rand(1, 4, 3), torch.tensor([[1.0, 2, 3, 6]])
    pairs: Counter[tuple[int, ...]] = Counter()
    for seed in range(3000):
        rows = RandomSampler(2, seed).sample_weighted(points, 2, weight)
        pairs[tuple(rows[0].tolist())] += 1
    total, statistic = 12.0, 0.0
    for i, j in permutations(range(4), 2):
        a, b = float(weight[0, i]), float(weight[0, j])
        expected = 3000 * a / total * b / (total - a)
        statistic += (pairs[i, j] - expected) ** 2 / expected
    assert chdtrc(11, statistic) > 1e-3
