"""Farthest points by groups beside those from all points: the same rows, bit for bit."""

import pytest
import torch
from torch.nn import functional as F

from mops_lightning import geometry
from mops_lightning.geometry import farthest_point_fill, farthest_point_sample

KINDS = ["sphere", "normal", "grid", "line", "copies", "one point", "far away", "tiny", "huge"]


def cloud(kind, n, dtype, rng):
    points = torch.randn(2, n, 3, dtype=dtype, generator=rng)
    if kind == "sphere":
        points = F.normalize(points, dim=2)
    if kind == "grid":  # many points are equally far
        points = points.mul(3).round()
    if kind == "line":
        points[..., 1:] = 0
    if kind == "copies":
        points[:, n // 2 :] = points[:, : n - n // 2]
    if kind == "one point":
        points[:] = 0.25
    if kind == "far away":
        points = points + 1000
    if kind == "tiny":
        points = points * torch.finfo(dtype).tiny
    if kind == "huge":  # squares of differences are infinite, some differences too
        points = points.clamp(-3, 3) / 3 * torch.finfo(dtype).max
    return points


@pytest.fixture
def by_groups(monkeypatch):
    """Call with groups whatever the sizes, and without them."""

    def both(function, *arguments, **options):
        results = []
        for least in (1, 10**9):
            monkeypatch.setattr(geometry, "MANY_POINTS", least)
            monkeypatch.setattr(geometry, "MANY_STEPS", 1)
            results.append(function(*arguments, **options))
        return results

    return both


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (90, 90), (128, 60), (1500, 700)])
def test_groups_give_the_rows_that_all_points_give(n, m, kind, dtype, rng, by_groups):
    points = cloud(kind, n, dtype, rng)
    start = torch.randint(n, (2,), generator=rng)
    groups, all_points = by_groups(farthest_point_sample, points, m, start=start)
    assert torch.equal(groups, all_points)


@pytest.mark.parametrize("kind", KINDS)
def test_groups_fill_up_as_all_points_do(kind, rng, by_groups):
    points = cloud(kind, 700, torch.float32, rng)
    indices = torch.stack([torch.randperm(700, generator=rng)[:200] for _ in range(2)])
    groups, all_points = by_groups(farthest_point_fill, points, indices, torch.tensor([1, 150]))
    assert torch.equal(groups, all_points)


@pytest.mark.parametrize("channels", [1, 2, 4])
def test_groups_in_other_dimensions(channels, rng, by_groups):
    points = torch.rand(1, 600, channels, generator=rng)
    groups, all_points = by_groups(farthest_point_sample, points, 300)
    assert torch.equal(groups, all_points)


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf])
def test_what_is_not_finite_is_left_to_the_search_of_all_points(wrong, rng, by_groups):
    points = torch.rand(1, 600, 3, generator=rng)
    points[0, 7, 0] = wrong
    groups, all_points = by_groups(farthest_point_sample, points, 300)
    assert torch.equal(groups, all_points)


def test_half_precision_is_searched_in_float32(rng, by_groups):
    points = torch.rand(1, 600, 3, generator=rng).half()
    groups, all_points = by_groups(farthest_point_sample, points, 300)
    assert torch.equal(groups, all_points)


def test_large_clouds_are_taken_by_groups(rng, monkeypatch):
    points, m = torch.rand(1, geometry.MANY_POINTS, 3, generator=rng), geometry.MANY_STEPS
    taken = farthest_point_sample(points, m, start=5)
    monkeypatch.setattr(geometry, "MANY_STEPS", m + 1)
    assert torch.equal(taken, farthest_point_sample(points, m, start=5))
