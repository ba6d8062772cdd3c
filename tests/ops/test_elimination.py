"""Sample elimination: the compiled loops, the torch form for GPUs, and the formula as published."""

import pytest
import torch

from mops_lightning.ops import elimination
from mops_lightning.ops.elimination import eliminate, eliminate_in_steps, spacing_bound
from tests.support.clouds import cloud_of

KINDS = ["sphere", "grid", "copies", "one point", "offset", "tiny", "huge", "outlier"]


def published(cloud, m, reach):
    """Sample elimination that sums all weights again before every removal."""
    kept = list(range(len(cloud)))
    while len(kept) > m:
        sums = []
        for i in kept:
            distances = [float((cloud[i] - cloud[j]).norm()) for j in kept if j != i]
            sums.append(sum(max(0.0, 1 - d / reach) ** 8 for d in distances))
        kept.pop(max(range(len(kept)), key=lambda place: sums[place]))
    return kept


def in_steps(points, m):
    """Return the result of the torch form, with the arguments that ``eliminate`` gives it."""
    points = points.double()
    reach = spacing_bound(points, m).clamp_min(torch.finfo(torch.float64).tiny)
    scale = 2.0 ** min(50, 62 - points.shape[1].bit_length())
    return eliminate_in_steps(points, m, reach, scale)


@pytest.mark.parametrize("form", [eliminate, in_steps])
@pytest.mark.parametrize("m", [2, 9, 23, 24])  # the last two points are equally crowded
def test_eliminate_equals_published_formula(m, form, rng):
    points = torch.randn(3, 24, 3, generator=rng, dtype=torch.float64)
    reach = spacing_bound(points, m)
    clouds = zip(points, reach, strict=True)
    expected = [published(cloud, m, float(bound)) for cloud, bound in clouds]
    assert form(points, m).tolist() == expected


@pytest.mark.parametrize("form", [eliminate, in_steps])
def test_eliminate_to_one_point_has_reach_of_bounding_box(form, rng):
    points = torch.randn(1, 24, 3, generator=rng, dtype=torch.float64)
    reach = float((points[0].amax(0) - points[0].amin(0)).norm())
    assert form(points, 1).tolist() == [published(points[0], 1, reach)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (40, 39), (40, 40), (300, 1), (300, 20), (300, 150)])
def test_eliminate_equals_torch_form(n, m, kind, rng):
    points = cloud_of(kind, (2, n), torch.float32, rng)
    assert torch.equal(eliminate(points, m), in_steps(points, m))


def test_eliminate_non_contiguous_equals_torch_form(rng):
    points = torch.rand(3, 400, 2, generator=rng, dtype=torch.float64).transpose(0, 2)[:, ::2]
    assert torch.equal(eliminate(points, 30), in_steps(points, 30))


def test_eliminate_in_steps_in_blocks_equals_whole(rng, monkeypatch):
    points = torch.randn(2, 24, 3, generator=rng)
    whole = in_steps(points, 9)
    monkeypatch.setattr(elimination, "BLOCK", 24 * 5)
    assert torch.equal(in_steps(points, 9), whole)


def test_eliminate_of_many_copies_does_not_overflow():
    points = torch.zeros(1, 8200, 3)
    points[0, 0] = 1.0
    kept = eliminate(points, 8199)
    assert kept[0, 0] == 0  # the only point that is not crowded


@pytest.mark.parametrize("m", [2, 5, 12])
def test_spacing_bound_is_upper_bound(m, rng):
    points = torch.randn(20, 30, 3, generator=rng, dtype=torch.float64)
    bound = spacing_bound(points, m)
    for _ in range(30):
        rows = torch.randperm(30, generator=rng)[:m]
        spacing = torch.cdist(points[:, rows], points[:, rows])
        spacing.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        assert (spacing.amin((1, 2)) <= bound[:, 0]).all()
