"""The compiled loops give the same rows as the torch forms, which GPUs use."""

from collections.abc import Callable
from functools import partial

import pytest
import torch

from mops_lightning.ops import compiled, farthest
from mops_lightning.ops.fps import farthest_point_fill, farthest_point_sample
from mops_lightning.ops.nearest import k_nearest, search_in_blocks
from mops_lightning.ops.nearest import nearest as nearest_points
from tests.support.clouds import cloud_of

KINDS = ["sphere", "normal", "grid", "line", "copies", "one point", "offset", "tiny", "huge"]
KINDS += ["outlier"]


@pytest.fixture
def both(monkeypatch):
    """Return a function that calls another in the compiled and in the torch form."""
    monkeypatch.setattr(compiled, "NEAREST_LEAF", 8)
    monkeypatch.setattr(farthest, "LEAF", 40)  # several levels

    def call(function, *arguments, **options):
        fast = function(*arguments, **options)
        with monkeypatch.context() as patch:
            patch.setattr(compiled, "nearest", lambda *_: None)
            patch.setattr(compiled, "farthest", lambda *_: None)
            return fast, function(*arguments, **options)

    return call


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("m", "n"), [(1, 1), (70, 9), (30, 800)])
def test_nearest_equals_torch_form(m, n, kind, dtype, rng, both):
    points, queries = cloud_of(kind, (2, n), dtype, rng), cloud_of(kind, (2, m), dtype, rng)
    queries[:, : min(m, n) // 2] = points[:, : min(m, n) // 2]
    (fast, rows), (plain, expected) = both(nearest_points, queries, points)
    assert torch.equal(rows, expected)
    assert torch.equal(fast, plain)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("m", "n", "k"), [(1, 2, 2), (70, 9, 9), (30, 800, 16), (5, 130, 33)])
def test_neighbours_equal_torch_form(m, n, k, kind, dtype, rng):
    points, queries = cloud_of(kind, (2, n), dtype, rng), cloud_of(kind, (2, m), dtype, rng)
    queries[:, : min(m, n) // 2] = points[:, : min(m, n) // 2]
    rows = k_nearest(queries, points, k)[1]
    total = torch.zeros(2, m, n, dtype=dtype)
    for axis in range(3):
        difference = points[:, None, :, axis] - queries[:, :, None, axis]
        total.addcmul_(difference, difference)
    assert torch.equal(rows, total.sort(stable=True)[1][..., :k])
    assert torch.equal(total.gather(2, search_in_blocks(queries, points, k)), total.gather(2, rows))


def test_nearest_of_centre_equals_torch_form(rng, both):
    """All points are almost equally far away, so that no box can be skipped."""
    points = cloud_of("sphere", (1, 500), torch.float32, rng)
    fast, plain = both(nearest_points, torch.zeros(1, 20, 3), points)
    assert torch.equal(fast[1], plain[1])


@pytest.mark.parametrize(
    ("place", "wrong"), [("queries", torch.nan), ("points", torch.nan), ("points", torch.inf)]
)
def test_nearest_non_finite_equals_torch_form(place, wrong, rng, both):
    arrays = {"queries": torch.rand(1, 40, 3), "points": torch.rand(1, 300, 3)}
    arrays[place][0, 7, 1] = wrong
    fast, plain = both(nearest_points, *arrays.values())
    assert torch.equal(fast[1], plain[1])


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_nearest_non_contiguous_equals_torch_form(dtype, rng, both):
    points = torch.rand(3, 400, 2, generator=rng).transpose(0, 2)[:, ::2].to(dtype)
    queries = torch.rand(3, 2, 90, generator=rng).permute(1, 2, 0).to(dtype)
    fast, plain = both(nearest_points, queries, points)
    assert torch.equal(fast[1], plain[1])


def test_nearest_gradients_equal_torch_form(rng, both):
    points = torch.rand(1, 60, 3, generator=rng, requires_grad=True)
    queries = torch.rand(1, 50, 3, generator=rng)
    fast, plain = both(
        lambda: torch.autograd.grad(nearest_points(queries, points)[0].sum(), points)
    )
    assert torch.equal(fast[0], plain[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (90, 90), (128, 60), (1500, 700)])
def test_farthest_equals_torch_form(n, m, kind, dtype, rng, both):
    points = cloud_of(kind, (2, n), dtype, rng)
    start = torch.randint(n, (2,), generator=rng)
    fast, plain = both(farthest_point_sample, points, m, start=start)
    assert torch.equal(fast, plain)


@pytest.mark.parametrize("kind", KINDS)
def test_fill_by_farthest_points_equals_torch_form(kind, rng, both):
    points = cloud_of(kind, (2, 700), torch.float32, rng)
    indices = torch.stack([torch.randperm(700, generator=rng)[:200] for _ in range(2)])
    fast, plain = both(farthest_point_fill, points, indices, torch.tensor([1, 150]))
    assert torch.equal(fast, plain)


def with_value(value):
    return torch.rand(1, 600, 3).index_put((torch.tensor(0), torch.tensor(7)), torch.tensor(value))


ODD: dict[str, Callable[[], torch.Tensor]] = {
    **{f"{number} channels": partial(torch.rand, 1, 600, number) for number in (1, 2, 4)},
    "NaN": lambda: with_value(torch.nan),
    "infinite": lambda: with_value(torch.inf),
    "half precision": lambda: torch.rand(1, 600, 3).half(),
    "not contiguous": lambda: torch.rand(3, 600, 2).transpose(0, 2)[:, ::2],
}


@pytest.mark.parametrize("kind", ODD)
def test_farthest_of_odd_points_equals_torch_form(kind, both):
    points = ODD[kind]()
    fast, plain = both(farthest_point_sample, points, 200, start=torch.arange(len(points)))
    assert torch.equal(fast, plain)


@pytest.mark.parametrize("threads", [1, 2])
def test_farthest_in_threads_equals_torch_form(threads, rng, both, monkeypatch):
    monkeypatch.setattr(farthest, "THREADS_MIN_WORK", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    points = torch.rand(5, 300, 3, generator=rng)
    fast, plain = both(farthest_point_sample, points, 100)
    assert torch.equal(fast, plain)


@pytest.mark.parametrize("k", [1, 3])
def test_compiled_forms_take_finite_points_only(k, rng):
    points = torch.rand(1, 30, 3, generator=rng)
    given = torch.zeros(1, 1, dtype=torch.int64), torch.ones(1, dtype=torch.int64)
    assert compiled.nearest(points[:, :5], points, k) is not None
    assert compiled.farthest(points, *given, 4) is not None
    points[0, 7, 0] = torch.nan
    assert compiled.nearest(points[:, :5], points, k) is None
    assert compiled.farthest(points, *given, 4) is None
