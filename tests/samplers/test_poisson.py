"""The compiled loops, a plain form in torch, and the formula as published; the sampler."""

from functools import partial

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


def eliminated_in_steps(cloud, m, share, weights_to):
    """Return the rows that are left of a cloud; ``weights_to`` gives the crowding by a row."""
    sums = weights_to(cloud[:, None]).sum(1)
    for _ in range(len(cloud) - m):
        compared = sums
        if share is not None:
            compared = (sums * share).long()
        worst = compared.argmax()
        sums -= weights_to(cloud[worst])
        sums[worst] = -1
    (kept,) = torch.where(sums > 0)
    return kept


def in_steps(points, m, weight=None):
    """Sample elimination with whole weights and the distances to all points in a step."""
    points = points.double()
    number = points.shape[1]
    reach = spacing_bound(points, m).clamp_min(torch.finfo(torch.float64).tiny)
    scale = 2.0 ** min(50, 62 - number.bit_length())

    def weights(cloud, bound, others):
        squared = torch.zeros((), dtype=torch.float64)
        for axis in range(others.shape[-1]):
            difference = cloud[..., axis] - others[..., axis]
            squared = squared + difference**2
        shares = squared.sqrt() * bound.reciprocal()
        eighth_power = (1 - shares).clamp_min(0).square().square().square()
        return (eighth_power * scale).long()

    kept = []
    for row, (cloud, bound) in enumerate(zip(points, reach, strict=True)):
        share = None
        if weight is not None:
            share = weight[row].amin() / weight[row]
        weights_to = partial(weights, cloud, bound)
        kept.append(eliminated_in_steps(cloud, m, share, weights_to))
    return torch.stack(kept)


@pytest.mark.parametrize("m", [2, 9, 23, 24])  # the last two points are equally crowded
def test_eliminate_equals_published_formula(m, randn):
    points = randn(3, 24, 3, dtype=torch.float64)
    reach = spacing_bound(points, m)

    kept = eliminate(points, m)

    for row, cloud in enumerate(points):
        expected = published(cloud, m, float(reach[row]))
        assert kept[row].tolist() == expected


def test_eliminate_to_one_point_has_reach_of_bounding_box(randn):
    cloud = randn(24, 3, dtype=torch.float64)
    diagonal = cloud.amax(0) - cloud.amin(0)

    kept = eliminate(cloud[None], 1)

    expected = published(cloud, 1, float(diagonal.norm()))
    assert kept.tolist() == [expected]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("n", "m"),
    [
        (1, 1),
        (40, 39),
        (40, 40),
        (300, 1),
        (300, 20),
        (300, 150),
    ],
)
def test_eliminate_equals_plain_form(n, m, kind, rng):
    points = cloud_of(kind, (2, n), torch.float32, rng)

    kept = eliminate(points, m)

    assert torch.equal(kept, in_steps(points, m))


@pytest.mark.parametrize("channels", [1, 2, 5])
@pytest.mark.parametrize("m", [1, 20, 150])
def test_eliminate_of_other_dimensions_equals_plain_form(m, channels, randn):
    points = randn(2, 300, channels, dtype=torch.float64)

    kept = eliminate(points, m)

    assert torch.equal(kept, in_steps(points, m))


@pytest.mark.parametrize("kind", ["sphere", "copies", "outlier"])
@pytest.mark.parametrize(
    ("n", "m"),
    [
        (40, 39),
        (300, 1),
        (300, 20),
        (300, 150),
    ],
)
def test_eliminate_divides_crowding_by_weight(n, m, kind, rng, rand):
    points = cloud_of(kind, (1, n), torch.float32, rng)
    weight = rand(1, n).double() + 0.01

    kept = eliminate(points, m, weight)

    assert torch.equal(kept, in_steps(points, m, weight))
    if kind == "sphere" and m == 150:
        weight_of_kept = weight.gather(1, kept)
        assert weight_of_kept.mean() > 1.2 * weight.mean()


def test_eliminate_of_many_copies_removes_the_lowest_row_of_them():
    points = torch.zeros(1, 8200, 3)
    points[0, 0] = 1.0

    kept = eliminate(points, 8199)

    # Row 0 is the only point that is not crowded; row 1 is the first of the others.
    assert kept[0].tolist() == [0, *range(2, 8200)]


def test_eliminate_of_points_not_contiguous_equals_plain_form(rand):
    points = rand(3, 400, 2, dtype=torch.float64)
    not_contiguous = points.transpose(0, 2)[:, ::2]

    kept = eliminate(not_contiguous, 30)

    assert torch.equal(kept, in_steps(not_contiguous, 30))


def test_poisson_of_points_with_gradients_keeps_the_same_points(rand):
    points = rand(2, 200, 3, dtype=torch.float64)
    with_gradients = points.clone().requires_grad_()
    sampler = PoissonSampler(30)

    kept = sampler(with_gradients).indices

    assert torch.equal(kept, sampler(points).indices)


def test_poisson_by_weight_keeps_heavy_points(rand):
    points = rand(2, 300, 3)
    weight = rand(2, 300) + 0.01

    rows = PoissonSampler(150).sample_weighted(points, 150, weight)

    weight_of_kept = weight.gather(1, rows)
    assert (weight_of_kept.mean(1) > 1.2 * weight.mean(1)).all()


def test_poisson_by_weight_does_not_depend_on_the_weights_of_other_clouds(rand):
    points = rand(2, 100, 3)
    weight = rand(2, 100).double() + 0.01
    weight[1] *= 1e-20

    first_row, _ = eliminate(points, 40, weight)

    (alone,) = eliminate(points[:1], 40, weight[:1])
    assert torch.equal(first_row, alone)


@pytest.mark.parametrize("m", [2, 5, 12])
def test_spacing_bound_is_upper_bound(m, rng, randn):
    points = randn(20, 30, 3, dtype=torch.float64)

    bound = spacing_bound(points, m)

    for _ in range(30):
        rows = torch.randperm(30, generator=rng)[:m]
        spacing_of_sample = spacing(points[:, rows])
        assert (spacing_of_sample <= bound[:, 0]).all()


def spacing(points):
    """Return the smallest distance between two points of each cloud."""
    distances = torch.cdist(points, points)
    distances.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    return distances.amin((1, 2))


def test_poisson_is_more_even_than_random(rand):
    flat = rand(8, 600, 3)
    flat[..., 2] = 0

    poisson = PoissonSampler(60)(flat)
    random = RandomSampler(60)(flat)
    fps = FPSSampler(60)(flat)

    even = spacing(poisson.points).mean()
    assert even > 4 * spacing(random.points).mean()
    assert even > 0.8 * spacing(fps.points).mean()
