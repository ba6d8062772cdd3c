from collections import Counter
from itertools import permutations
from statistics import mean

import pytest
import torch
from scipy.special import chdtrc

from mops_lightning.samplers.random import RandomSampler


def chi_square_p(counts, expected, share):
    """Return the p-value of equal counts, where each event draws this share of the cells."""
    squares = [(count - expected) ** 2 for count in counts]
    statistic = sum(squares) / (expected * (1 - share))
    number = len(counts)
    freedom = number - 1
    return chdtrc(freedom, statistic * freedom / number)


def test_random_places_are_uniform(randn):
    """Neither points on one side of a cloud nor points near its centre are preferred."""
    points = randn(4000, 50, 3)
    sides = points[..., 0]
    radii = points.norm(dim=2)

    indices = RandomSampler(10)(points).indices

    for values in (sides, radii):
        ranks = values.argsort(1).argsort(1)
        chosen_ranks = ranks.gather(1, indices)
        counts = chosen_ranks.flatten().bincount(minlength=50).tolist()
        assert chi_square_p(counts, 4000 * 10 / 50, 10 / 50) > 1e-3


def test_random_pairs_are_uniform(rng):
    points = torch.randint(0, 3, (1, 5, 3), generator=rng) / 4  # few bits to hash
    points[..., 0] += torch.arange(5)

    pairs: Counter[tuple[int, ...]] = Counter()
    for seed in range(1500):
        (rows,) = RandomSampler(2, seed)(points).indices
        pairs[tuple(rows.tolist())] += 1

    counts = [pairs[pair] for pair in permutations(range(5), 2)]
    assert chi_square_p(counts, 1500 / 20, 1 / 20) > 1e-3


def test_random_shared_point_is_chosen_independently(randn):
    points = randn(4000, 20, 3)
    points[:, 0] = 0.0

    rows = RandomSampler(5)(points).indices

    is_chosen = (rows == 0).any(1)
    share = is_chosen.float().mean()
    assert share.item() == pytest.approx(5 / 20, abs=0.03)


def test_random_copies_are_chosen_independently(randn):
    """100 draws from 200 points with two copies each give about 88 distinct points."""
    points = randn(20, 200, 3)
    twice = torch.cat([points, points], 1)

    rows = RandomSampler(100)(twice).indices % 200

    different = [len(row.unique()) for row in rows]
    neither_copy = (300 * 299) / (400 * 399)
    expected = 200 * (1 - neither_copy)
    assert mean(different) == pytest.approx(expected, abs=2.5)


def test_random_by_weight_equals_successive_draws():
    """The probability of a pair is the product of two draws in proportion to the weights."""
    points = torch.rand(1, 4, 3)
    weights = [1.0, 2.0, 3.0, 6.0]
    weight = torch.tensor([weights])

    pairs: Counter[tuple[int, ...]] = Counter()
    for seed in range(3000):
        (rows,) = RandomSampler(2, seed).sample_weighted(points, 2, weight)
        pairs[tuple(rows.tolist())] += 1

    total = sum(weights)
    statistic = 0.0
    for first, second in permutations(range(4), 2):
        left = total - weights[first]
        share_of_first = weights[first] / total
        share_of_second = weights[second] / left
        expected = 3000 * share_of_first * share_of_second
        excess = pairs[first, second] - expected
        statistic += excess**2 / expected
    assert chdtrc(11, statistic) > 1e-3
