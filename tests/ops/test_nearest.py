"""Distances by a tree beside those from all points."""

import pytest
import torch
from torch.nn import functional as F

from mops_lightning.ops import nearest as search
from mops_lightning.ops.nearest import nearest, nearest_distances


@pytest.fixture
def counted(monkeypatch):
    """Trees for small clouds too, and a list that grows with each."""
    built = []

    def tree(points):
        built.append(len(points))
        return KDTree(points)

    KDTree = search.cKDTree
    monkeypatch.setattr(search, "cKDTree", tree)
    monkeypatch.setattr(search, "MANY_PAIRS", 1)
    return built


def sphere(n, rng, dtype=torch.float32):
    return F.normalize(torch.randn(2, n, 3, generator=rng, dtype=dtype), dim=2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("m", "n"), [(600, 800), (30, 900), (900, 700)])
def test_a_tree_gives_the_distances_and_gradients_of_all_points(m, n, dtype, rng, counted):
    points = sphere(n, rng, dtype).requires_grad_()
    noise = 0.02 * torch.randn(2, m, 3, generator=rng, dtype=dtype)
    queries = (sphere(m, rng, dtype) + noise).requires_grad_()
    weight = torch.rand(2, m, generator=rng, dtype=dtype)
    found = nearest_distances(queries, points)
    assert counted == [n, n]
    plain = nearest(queries, points)[0]
    torch.testing.assert_close(found, plain, rtol=1e-6, atol=0)
    for got, wanted in zip(
        torch.autograd.grad((found * weight).sum(), (queries, points)),
        torch.autograd.grad((plain * weight).sum(), (queries, points)),
        strict=True,
    ):
        torch.testing.assert_close(got, wanted, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(
    "queries",
    [torch.zeros(2, 500, 3), torch.full((2, 500, 3), torch.nan), torch.full((2, 500, 3), 1e30)],
)
def test_no_tree_where_it_would_look_at_everything(queries, rng, counted):
    points = sphere(800, rng)
    found = nearest_distances(queries, points)
    assert counted == []
    torch.testing.assert_close(found, nearest(queries, points)[0], equal_nan=True)


def test_coincident_points_are_near(rng, counted):
    points = sphere(800, rng)
    points[:, 400:] = points[:, :400]
    assert not nearest_distances(points, points).any()
    assert counted == [800, 800]


def test_small_clouds_are_searched_as_before(rng, monkeypatch):
    monkeypatch.setattr(search, "cKDTree", None)
    points = sphere(300, rng)
    assert torch.equal(nearest_distances(points, points), nearest(points, points)[0])
