"""Compiled forms give the same rows as plain ones; farthest points are in ``test_fps_cpu``."""

import pytest
import torch

from mops_lightning.ops import compiled, nearest
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.nearest import nearest as nearest_points
from mops_lightning.samplers.poisson import eliminate
from tests.support.clouds import cloud_of

KINDS = ["sphere", "grid", "copies", "one point", "offset", "tiny", "huge", "outlier"]


@pytest.fixture
def both(monkeypatch):
    """Return a function that calls another in the compiled and in the plain form."""
    pytest.importorskip("numba", reason="needs mops-lightning[fast]")
    module = compiled.kernels()
    assert module is not None
    monkeypatch.setattr(nearest, "COMPILED_MIN_PAIRS", 1)
    monkeypatch.setattr(compiled, "NEAREST_LEAF", 8)

    def call(function, *arguments):
        results = []
        for form in (module, None):
            monkeypatch.setattr(compiled, "kernels", lambda form=form: form)
            results.append(function(*arguments))
        return results

    return call


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("m", "n"), [(1, 1), (70, 9), (30, 800)])
def test_nearest_equals_plain_form(m, n, kind, dtype, rng, both):
    points, queries = cloud_of(kind, (2, n), dtype, rng), cloud_of(kind, (2, m), dtype, rng)
    queries[:, : min(m, n) // 2] = points[:, : min(m, n) // 2]
    (fast, rows), (plain, expected) = both(nearest_points, queries, points)
    assert torch.equal(rows, expected)
    assert torch.equal(fast, plain)


def test_nearest_of_centre_equals_plain_form(rng, both):
    """All points are almost equally far away, so that no box can be skipped."""
    points = cloud_of("sphere", (1, 500), torch.float32, rng)
    fast, plain = both(nearest_points, torch.zeros(1, 20, 3), points)
    assert torch.equal(fast[1], plain[1])


@pytest.mark.parametrize(
    ("place", "wrong"), [("queries", torch.nan), ("points", torch.nan), ("points", torch.inf)]
)
def test_nearest_non_finite_equals_plain_form(place, wrong, rng, both):
    arrays = {"queries": torch.rand(1, 40, 3), "points": torch.rand(1, 300, 3)}
    arrays[place][0, 7, 1] = wrong
    fast, plain = both(nearest_points, *arrays.values())
    assert torch.equal(fast[1], plain[1])


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_nearest_non_contiguous_equals_plain_form(dtype, rng, both):
    points = torch.rand(3, 400, 2, generator=rng).transpose(0, 2)[:, ::2].to(dtype)
    queries = torch.rand(3, 2, 90, generator=rng).permute(1, 2, 0).to(dtype)
    fast, plain = both(nearest_points, queries, points)
    assert torch.equal(fast[1], plain[1])


def test_nearest_gradients_equal_plain_form(rng, both):
    points = torch.rand(1, 60, 3, generator=rng, requires_grad=True)
    queries = torch.rand(1, 50, 3, generator=rng)
    fast, plain = both(
        lambda: torch.autograd.grad(nearest_points(queries, points)[0].sum(), points)
    )
    assert torch.equal(fast[0], plain[0])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (40, 39), (40, 40), (300, 1), (300, 20), (300, 150)])
def test_eliminate_equals_plain_form(n, m, kind, rng, both):
    points = cloud_of(kind, (2, n), torch.float32, rng)
    fast, plain = both(eliminate, points, m)
    assert torch.equal(fast, plain)


def test_eliminate_non_contiguous_equals_plain_form(rng, both):
    points = torch.rand(3, 400, 2, generator=rng, dtype=torch.float64).transpose(0, 2)[:, ::2]
    fast, plain = both(eliminate, points, 30)
    assert torch.equal(fast, plain)


def test_compiled_forms_take_finite_points_on_cpu(rng):
    pytest.importorskip("numba", reason="needs mops-lightning[fast]")
    points = torch.rand(1, 30, 3, generator=rng)
    found, chosen = compiled.nearest(points[:, :5], points), compiled.farthest(points, 4)
    assert found is not None
    assert chosen is not None
    assert found.tolist() == [list(range(5))]
    points[0, 7, 0] = torch.nan
    assert compiled.nearest(points[:, :5], points) is None
    assert compiled.farthest(points, 4) is None


def test_kernels_other_rounding_returns_plain_form(rng, monkeypatch):
    """Distances that torch rounds in a third way are not computed by compiled code."""
    points = torch.rand(2, 100, 3, generator=rng)
    expected = farthest_point_sample(points, 20)
    monkeypatch.setattr(compiled, "sum_of_squares_", lambda planes: planes[0] + 1e-6)
    compiled._fused.cache_clear()
    compiled._kernels.cache_clear()
    try:
        assert compiled.kernels() is None
        assert torch.equal(farthest_point_sample(points, 20), expected)
    finally:
        monkeypatch.undo()
        compiled._fused.cache_clear()
        compiled._kernels.cache_clear()
