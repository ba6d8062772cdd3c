"""The compiled loops give the same rows as the torch forms, which GPUs use."""

from collections.abc import Callable

import pytest
import torch

from mops_lightning.ops import compiled, farthest
from mops_lightning.ops.fps import farthest_point_fill, farthest_point_sample
from mops_lightning.ops.nearest import k_nearest, search_in_blocks
from mops_lightning.ops.nearest import nearest as nearest_points
from tests.support.clouds import cloud_of

KINDS = [
    "sphere",
    "normal",
    "grid",
    "line",
    "copies",
    "one point",
    "offset",
    "tiny",
    "huge",
    "outlier",
]


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


def points_and_queries(kind, n, m, dtype, rng):
    """Return two clouds of a kind; half of the smaller one is copied from the other."""
    points = cloud_of(kind, (2, n), dtype, rng)
    queries = cloud_of(kind, (2, m), dtype, rng)
    copies = min(m, n) // 2
    queries[:, :copies] = points[:, :copies]
    return points, queries


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("m", "n"), [(1, 1), (70, 9), (30, 800)])
def test_nearest_equals_torch_form(m, n, kind, dtype, rng, both):
    points, queries = points_and_queries(kind, n, m, dtype, rng)

    fast, plain = both(nearest_points, queries, points)

    distances, rows = fast
    expected_distances, expected_rows = plain
    assert torch.equal(rows, expected_rows)
    assert torch.equal(distances, expected_distances)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("m", "n", "k"),
    [
        (1, 2, 2),
        (70, 9, 9),
        (30, 800, 16),
        (5, 130, 33),
    ],
)
def test_neighbours_equal_torch_form(m, n, k, kind, dtype, rng):
    points, queries = points_and_queries(kind, n, m, dtype, rng)

    _, rows = k_nearest(queries, points, k)
    rows_by_blocks = search_in_blocks(queries, points, k)

    squared = squared_distances(queries, points)
    _, in_order = squared.sort(stable=True)
    distances = squared.gather(2, rows)
    distances_by_blocks = squared.gather(2, rows_by_blocks)
    assert torch.equal(rows, in_order[..., :k])
    assert torch.equal(distances_by_blocks, distances)


def squared_distances(queries, points):
    """Return all squared distances ``(B, M, N)``, added up in the order of the axes."""
    shape = (*queries.shape[:2], points.shape[1])
    squared = torch.zeros(shape, dtype=points.dtype)
    for axis in range(3):
        of_queries = queries[:, :, None, axis]
        of_points = points[:, None, :, axis]
        difference = of_points - of_queries
        squared.addcmul_(difference, difference)
    return squared


def test_nearest_of_centre_equals_torch_form(rng, both):
    """All points are almost equally far away, so that no box can be skipped."""
    points = cloud_of("sphere", (1, 500), torch.float32, rng)
    centres = torch.zeros(1, 20, 3)

    fast, plain = both(nearest_points, centres, points)

    assert torch.equal(fast[1], plain[1])


@pytest.mark.parametrize(
    ("place", "wrong"),
    [
        ("queries", torch.nan),
        ("points", torch.nan),
        ("points", torch.inf),
    ],
)
def test_nearest_non_finite_equals_torch_form(place, wrong, rng, both):
    queries = torch.rand(1, 40, 3)
    points = torch.rand(1, 300, 3)
    broken = queries if place == "queries" else points
    broken[0, 7, 1] = wrong

    fast, plain = both(nearest_points, queries, points)

    assert torch.equal(fast[1], plain[1])


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_nearest_non_contiguous_equals_torch_form(dtype, rand, both):
    points = rand(3, 400, 2).transpose(0, 2)[:, ::2]
    queries = rand(3, 2, 90).permute(1, 2, 0)

    fast, plain = both(nearest_points, queries.to(dtype), points.to(dtype))

    assert torch.equal(fast[1], plain[1])


def test_nearest_gradients_equal_torch_form(rand, both):
    points = rand(1, 60, 3, requires_grad=True)
    queries = rand(1, 50, 3)

    def gradient():
        distances, _ = nearest_points(queries, points)
        return torch.autograd.grad(distances.sum(), points)

    (fast,), (plain,) = both(gradient)

    assert torch.equal(fast, plain)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("n", "m"),
    [
        (1, 1),
        (90, 90),
        (128, 60),
        (1500, 700),
    ],
)
def test_farthest_equals_torch_form(n, m, kind, dtype, rng, both):
    points = cloud_of(kind, (2, n), dtype, rng)
    start = torch.randint(n, (2,), generator=rng)

    fast, plain = both(farthest_point_sample, points, m, start=start)

    assert torch.equal(fast, plain)


@pytest.mark.parametrize("kind", KINDS)
def test_fill_by_farthest_points_equals_torch_form(kind, rng, both):
    points = cloud_of(kind, (2, 700), torch.float32, rng)
    first = torch.randperm(700, generator=rng)[:200]
    second = torch.randperm(700, generator=rng)[:200]
    indices = torch.stack([first, second])
    counts = torch.tensor([1, 150])

    fast, plain = both(farthest_point_fill, points, indices, counts)

    assert torch.equal(fast, plain)


def with_value(value):
    points = torch.rand(1, 600, 3)
    points[0, 7] = value
    return points


ODD: dict[str, Callable[[], torch.Tensor]] = {
    "1 channels": lambda: torch.rand(1, 600, 1),
    "2 channels": lambda: torch.rand(1, 600, 2),
    "4 channels": lambda: torch.rand(1, 600, 4),
    "NaN": lambda: with_value(torch.nan),
    "infinite": lambda: with_value(torch.inf),
    "half precision": lambda: torch.rand(1, 600, 3).half(),
    "not contiguous": lambda: torch.rand(3, 600, 2).transpose(0, 2)[:, ::2],
}


@pytest.mark.parametrize("kind", ODD)
def test_farthest_of_odd_points_equals_torch_form(kind, both):
    points = ODD[kind]()
    start = torch.arange(len(points))

    fast, plain = both(farthest_point_sample, points, 200, start=start)

    assert torch.equal(fast, plain)


@pytest.mark.parametrize("threads", [1, 2])
def test_farthest_in_threads_equals_torch_form(threads, rand, both, monkeypatch):
    monkeypatch.setattr(farthest, "THREADS_MIN_WORK", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    points = rand(5, 300, 3)

    fast, plain = both(farthest_point_sample, points, 100)

    assert torch.equal(fast, plain)


@pytest.mark.parametrize("k", [1, 3])
def test_compiled_forms_take_finite_points_only(k, rand):
    finite = rand(1, 30, 3)
    with_nan = finite.clone()
    with_nan[0, 7, 0] = torch.nan
    indices = torch.zeros(1, 1, dtype=torch.int64)
    counts = torch.ones(1, dtype=torch.int64)

    assert compiled.nearest(finite[:, :5], finite, k) is not None
    assert compiled.farthest(finite, indices, counts, 4) is not None
    assert compiled.nearest(with_nan[:, :5], with_nan, k) is None
    assert compiled.farthest(with_nan, indices, counts, 4) is None


def test_weighted_farthest_in_threads_equals_torch_form(rand, both, monkeypatch):
    monkeypatch.setattr(farthest, "THREADS_MIN_WORK", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    points = rand(5, 300, 3)
    weight = rand(5, 300) + 0.1

    fast, plain = both(farthest_point_sample, points, 100, 0, weight)

    assert torch.equal(fast, plain)


def test_nearest_in_threads_equals_torch_form(rand, both, monkeypatch):
    monkeypatch.setattr(compiled, "THREADS_MIN_WORK", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    points = rand(5, 300, 3)
    queries = rand(5, 20, 3)

    fast, plain = both(nearest_points, queries, points)

    assert torch.equal(fast[1], plain[1])


def test_neighbours_in_threads_take_finite_points_only(rand, monkeypatch):
    monkeypatch.setattr(compiled, "THREADS_MIN_WORK", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    points = rand(2, 30, 3)
    queries = points[:, :5]
    expected = compiled.nearest(queries, points.clone(), 3)
    with_nan = points.clone()
    with_nan[1, 7, 0] = torch.nan

    assert expected is not None
    assert torch.equal(expected, k_nearest(queries, points, 3)[1])
    assert compiled.nearest(queries, with_nan, 3) is None
