"""The CPU variants of farthest point sampling give the same rows as exhaustive search."""

import pytest
import torch

from mops_lightning.ops import compiled, fps, fps_cpu
from mops_lightning.ops.fps import farthest_point_fill, farthest_point_sample
from tests.support.clouds import cloud_of

KINDS = ["sphere", "normal", "grid", "line", "copies", "one point", "offset", "tiny", "huge"]


@pytest.fixture(params=["groups", "table", "compiled"])
def both(request, monkeypatch):
    """Return a function that calls another in one of the fast forms, and in the plain one."""
    if request.param == "compiled":
        pytest.importorskip("numba", reason="needs mops-lightning[fast]")
        monkeypatch.setattr(compiled, "FARTHEST_LEAF", 40)  # several levels
    module = compiled.kernels()

    def call(function, *arguments, **options):
        results = []
        for fast in (True, False):
            groups, table, numba = (
                fast and request.param == variant for variant in ("groups", "table", "compiled")
            )
            monkeypatch.setattr(compiled, "kernels", lambda on=numba: module if on else None)
            monkeypatch.setattr(fps, "GROUPS_MIN_POINTS", 1 if groups else 10**9)
            monkeypatch.setattr(fps, "GROUPS_MIN_STEPS", 1)
            monkeypatch.setattr(fps, "TABLE_MAX_POINTS", 10**9 if table else 0)
            results.append(function(*arguments, **options))
        return results

    return call


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (90, 90), (128, 60), (1500, 700)])
def test_sample_equals_exhaustive_search(n, m, kind, dtype, rng, both):
    points = cloud_of(kind, (2, n), dtype, rng)
    start = torch.randint(n, (2,), generator=rng)
    fast, plain = both(farthest_point_sample, points, m, start=start)
    assert torch.equal(fast, plain)


@pytest.mark.parametrize("kind", KINDS)
def test_fill_equals_exhaustive_search(kind, rng, both):
    points = cloud_of(kind, (2, 700), torch.float32, rng)
    indices = torch.stack([torch.randperm(700, generator=rng)[:200] for _ in range(2)])
    fast, plain = both(farthest_point_fill, points, indices, torch.tensor([1, 150]))
    assert torch.equal(fast, plain)


@pytest.mark.parametrize("channels", [1, 2, 4])
def test_sample_other_dimensions_equals_exhaustive_search(channels, rng, both):
    points = torch.rand(1, 600, channels, generator=rng)
    fast, plain = both(farthest_point_sample, points, 300)
    assert torch.equal(fast, plain)


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf])
def test_sample_non_finite_equals_exhaustive_search(wrong, rng, both):
    points = torch.rand(1, 600, 3, generator=rng)
    points[0, 7, 0] = wrong
    fast, plain = both(farthest_point_sample, points, 300)
    assert torch.equal(fast, plain)


def test_sample_half_precision_equals_exhaustive_search(rng, both):
    points = torch.rand(1, 600, 3, generator=rng).half()
    fast, plain = both(farthest_point_sample, points, 300)
    assert torch.equal(fast, plain)


def test_sample_non_contiguous_equals_exhaustive_search(rng, both):
    points = torch.rand(3, 600, 2, generator=rng).transpose(0, 2)[:, ::2]
    start = torch.tensor([5, 0])
    fast, plain = both(farthest_point_sample, points, 200, start=start)
    assert torch.equal(fast, plain)


@pytest.mark.parametrize("threads", [1, 2])
def test_sample_in_threads_equals_exhaustive_search(threads, rng, both, monkeypatch):
    monkeypatch.setattr(compiled, "THREADS_MIN_WORK", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    points = torch.rand(5, 300, 3, generator=rng)
    fast, plain = both(farthest_point_sample, points, 100)
    assert torch.equal(fast, plain)


def test_sample_large_cloud_equals_exhaustive_search(rng, monkeypatch):
    monkeypatch.setattr(compiled, "kernels", lambda: None)
    points, m = torch.rand(1, fps.GROUPS_MIN_POINTS, 3, generator=rng), fps.GROUPS_MIN_STEPS
    taken = farthest_point_sample(points, m, start=5)
    monkeypatch.setattr(fps, "GROUPS_MIN_STEPS", m + 1)
    assert torch.equal(taken, farthest_point_sample(points, m, start=5))


@pytest.mark.parametrize(
    ("clouds", "n", "m", "tables"),
    [(4, 1024, 128, 4), (4, 1024, 127, 0), (5, 1024, 128, 0), (1, 1025, 900, 0), (1, 8, 8, 1)],
)
def test_sample_uses_table_for_few_small_clouds(clouds, n, m, tables, rng, monkeypatch):
    sizes = []

    def counted(points, distances, steps):
        sizes.append(len(points))
        return fps_cpu.farthest_by_distance_table(points, distances, steps)

    monkeypatch.setattr(compiled, "kernels", lambda: None)
    monkeypatch.setattr(fps, "farthest_by_distance_table", counted)
    points = torch.rand(clouds, n, 3, generator=rng)
    taken = farthest_point_sample(points, m)
    assert sizes == [n] * tables
    monkeypatch.setattr(fps, "TABLE_MAX_POINTS", 0)
    assert torch.equal(taken, farthest_point_sample(points, m))


def test_groups_are_compact_so_that_a_step_updates_few_points(rng, monkeypatch):
    updated: list[int] = []
    sum_of_squares_ = fps_cpu.sum_of_squares_

    def counted(planes):
        updated.append(planes[0].numel())
        return sum_of_squares_(planes)

    monkeypatch.setattr(fps_cpu, "sum_of_squares_", counted)
    points = torch.rand(6000, 3, generator=rng) * 5 - 2
    first = torch.full((6000,), torch.finfo(torch.float32).max)
    fps_cpu.farthest_by_groups(points, first, 200)
    assert len(updated) == 200
    assert sum(updated) < 0.35 * 200 * 6000
