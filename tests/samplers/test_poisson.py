"""The compiled loops, a plain form in torch, and the formula as published; the sampler."""

import pytest
import torch

from mops_lightning import FPSSampler, RandomSampler
from mops_lightning.samplers.poisson import PoissonSampler, eliminate, spacing_bound
from tests.support.clouds import cloud_of

KINDS = ["sphere", "grid", "copies", "one point", "offset", "tiny", "huge", "outlier"]


def published(cloud, m, reach):
    """Sample elimination that sums all weights again before every removal."""
    kept = list(range(len(cloud)))
    while len(kept) > m:
        sums = [crowding(cloud, row, kept, reach) for row in kept]
        kept.pop(sums.index(max(sums)))
    return kept


def crowding(cloud, row, kept, reach):
    """Add up the weights of all other kept points."""
    total = 0.0
    for other in kept:
        if other != row:
            distance = float((cloud[row] - cloud[other]).norm())
            total += max(0.0, 1 - distance / reach) ** 8
    return total


def in_steps(points, m, weight=None):
    """Sample elimination with whole weights and the distances to all points in a step."""
    points = points.double()
    number = points.shape[1]
    reach = spacing_bound(points, m).clamp_min(torch.finfo(torch.float64).tiny)
    scale = 2.0 ** min(50, 62 - number.bit_length())

    def weights(cloud, others, bound):
        axes = range(others.shape[-1])
        squared = sum((cloud[..., axis] - others[..., axis]) ** 2 for axis in axes)
        shares = squared.sqrt() * bound.reciprocal()
        return ((1 - shares).clamp_min(0).square().square().square() * scale).long()

    kept = []
    shares = torch.ones(points.shape[:2])
    if weight is not None:
        shares = weight.amin() / weight
    for cloud, bound, share in zip(points, reach, shares, strict=True):
        sums = weights(cloud, cloud[:, None], bound).sum(1)
        for _ in range(number - m):
            compared = sums
            if weight is not None:
                compared = (sums * share).long()
            worst = compared.argmax()
            sums -= weights(cloud, cloud[worst], bound)
            sums[worst] = -1
        kept.append((sums > 0).nonzero()[:, 0])
    return torch.stack(kept)


@pytest.mark.parametrize("m", [2, 9, 23, 24])  # the last two points are equally crowded
def test_eliminate_equals_published_formula(m, rng):
    points = torch.randn(3, 24, 3, generator=rng, dtype=torch.float64)
    reach = spacing_bound(points, m)

    kept = eliminate(points, m).tolist()

    assert kept[0] == published(points[0], m, float(reach[0]))
    assert kept[1] == published(points[1], m, float(reach[1]))
    assert kept[2] == published(points[2], m, float(reach[2]))


def test_eliminate_to_one_point_has_reach_of_bounding_box(rng):
    points = torch.randn(1, 24, 3, generator=rng, dtype=torch.float64)
    reach = float((points[0].amax(0) - points[0].amin(0)).norm())

    assert eliminate(points, 1).tolist() == [published(points[0], 1, reach)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (40, 39), (40, 40), (300, 1), (300, 20), (300, 150)])
def test_eliminate_equals_plain_form(n, m, kind, rng):
    points = cloud_of(kind, (2, n), torch.float32, rng)

    assert torch.equal(eliminate(points, m), in_steps(points, m))


@pytest.mark.parametrize("channels", [1, 2, 5])
@pytest.mark.parametrize("m", [1, 20, 150])
def test_eliminate_of_other_dimensions_equals_plain_form(m, channels, rng):
    points = torch.randn(2, 300, channels, generator=rng, dtype=torch.float64)

    assert torch.equal(eliminate(points, m), in_steps(points, m))


@pytest.mark.parametrize("kind", ["sphere", "copies", "outlier"])
@pytest.mark.parametrize(("n", "m"), [(40, 39), (300, 1), (300, 20), (300, 150)])
def test_eliminate_divides_crowding_by_weight(n, m, kind, rng):
    points = cloud_of(kind, (1, n), torch.float32, rng)
    weight = torch.rand(1, n, generator=rng).double() + 0.01

    kept = eliminate(points, m, weight)

    assert torch.equal(kept, in_steps(points, m, weight))
    if kind == "sphere" and m == 150:
        assert weight.gather(1, kept).mean() > 1.2 * weight.mean()


def test_eliminate_of_points_not_contiguous_or_with_gradients_equals_plain_form(rng):
    points = torch.rand(3, 400, 2, generator=rng, dtype=torch.float64).transpose(0, 2)[:, ::2]

    assert torch.equal(eliminate(points, 30), in_steps(points, 30))
    chosen = PoissonSampler(30)(points.clone().requires_grad_()).indices
    assert torch.equal(chosen, PoissonSampler(30)(points).indices)


def test_eliminate_of_many_copies_removes_the_lowest_row_of_them():
    points = torch.zeros(1, 8200, 3)
    points[0, 0] = 1.0

    kept = eliminate(points, 8199)

    # Row 0 is the only point that is not crowded; row 1 is the first of the others.
    assert kept[0].tolist() == [0, *range(2, 8200)]


@pytest.mark.parametrize("m", [2, 5, 12])
def test_spacing_bound_is_upper_bound(m, rng):
    points = torch.randn(20, 30, 3, generator=rng, dtype=torch.float64)

    bound = spacing_bound(points, m)

    for _ in range(30):
        rows = torch.randperm(30, generator=rng)[:m]
        spacing = torch.cdist(points[:, rows], points[:, rows])
        spacing.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        assert (spacing.amin((1, 2)) <= bound[:, 0]).all()


def spacing(points):
    distances = torch.cdist(points, points)
    distances.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    return distances.amin((1, 2)).mean()


def test_poisson_is_more_even_than_random(rng):
    flat = torch.rand(8, 600, 3, generator=rng) * torch.tensor([1.0, 1.0, 0.0])

    even = spacing(PoissonSampler(60)(flat).points)

    assert even > 4 * spacing(RandomSampler(60)(flat).points)
    assert even > 0.8 * spacing(FPSSampler(60)(flat).points)
