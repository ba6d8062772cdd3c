"""Farthest points by groups or a table beside those from all points: the same rows, bit for bit."""

import pytest
import torch
from torch.nn import functional as F

from mops_lightning.ops import fps, fps_cpu
from mops_lightning.ops.fps import farthest_point_fill, farthest_point_sample

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


@pytest.fixture(params=["groups", "table"])
def both_ways(request, monkeypatch):
    """Call with groups or a table whatever the sizes, and without them."""

    def both(function, *arguments, **options):
        results = []
        for special in (True, False):
            groups, table = (special and request.param == way for way in ("groups", "table"))
            monkeypatch.setattr(fps, "MANY_POINTS", 1 if groups else 10**9)
            monkeypatch.setattr(fps, "MANY_STEPS", 1)
            monkeypatch.setattr(fps, "FEW_POINTS", 10**9 if table else 0)
            results.append(function(*arguments, **options))
        return results

    return both


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (90, 90), (128, 60), (1500, 700)])
def test_both_give_the_rows_that_all_points_give(n, m, kind, dtype, rng, both_ways):
    points = cloud(kind, n, dtype, rng)
    start = torch.randint(n, (2,), generator=rng)
    special, all_points = both_ways(farthest_point_sample, points, m, start=start)
    assert torch.equal(special, all_points)


@pytest.mark.parametrize("kind", KINDS)
def test_both_fill_up_as_all_points_do(kind, rng, both_ways):
    points = cloud(kind, 700, torch.float32, rng)
    indices = torch.stack([torch.randperm(700, generator=rng)[:200] for _ in range(2)])
    special, all_points = both_ways(farthest_point_fill, points, indices, torch.tensor([1, 150]))
    assert torch.equal(special, all_points)


@pytest.mark.parametrize("channels", [1, 2, 4])
def test_both_in_other_dimensions(channels, rng, both_ways):
    points = torch.rand(1, 600, channels, generator=rng)
    special, all_points = both_ways(farthest_point_sample, points, 300)
    assert torch.equal(special, all_points)


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf])
def test_what_is_not_finite_is_left_to_the_search_of_all_points(wrong, rng, both_ways):
    points = torch.rand(1, 600, 3, generator=rng)
    points[0, 7, 0] = wrong
    special, all_points = both_ways(farthest_point_sample, points, 300)
    assert torch.equal(special, all_points)


def test_half_precision_is_searched_in_float32(rng, both_ways):
    points = torch.rand(1, 600, 3, generator=rng).half()
    special, all_points = both_ways(farthest_point_sample, points, 300)
    assert torch.equal(special, all_points)


def test_large_clouds_are_taken_by_groups(rng, monkeypatch):
    points, m = torch.rand(1, fps.MANY_POINTS, 3, generator=rng), fps.MANY_STEPS
    taken = farthest_point_sample(points, m, start=5)
    monkeypatch.setattr(fps, "MANY_STEPS", m + 1)
    assert torch.equal(taken, farthest_point_sample(points, m, start=5))


@pytest.mark.parametrize(
    ("clouds", "n", "m", "tables"),
    [(4, 1024, 128, 4), (4, 1024, 127, 0), (5, 1024, 128, 0), (1, 1025, 900, 0), (1, 8, 8, 1)],
)
def test_few_small_clouds_are_taken_from_a_table(clouds, n, m, tables, rng, monkeypatch):
    sizes = []

    def counted(points, distances, steps):
        sizes.append(len(points))
        return fps_cpu.take_farthest_by_table(points, distances, steps)

    monkeypatch.setattr(fps, "take_farthest_by_table", counted)
    points = torch.rand(clouds, n, 3, generator=rng)
    taken = farthest_point_sample(points, m)
    assert sizes == [n] * tables
    monkeypatch.setattr(fps, "FEW_POINTS", 0)
    assert torch.equal(taken, farthest_point_sample(points, m))
