import pytest
import torch
from scipy.spatial import cKDTree

from mops_lightning.errors import UserError
from mops_lightning.ops import compiled
from mops_lightning.ops import nearest as search
from mops_lightning.ops.nearest import chamfer_distance, k_nearest, nearest
from mops_lightning.ops.points import gather_points
from tests.support.plain import plain_nearest


@pytest.mark.parametrize("form", ["compiled", "torch"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [5, 32, 75])
def test_nearest_equals_double_loop(n, dtype, form, rng, monkeypatch):
    if form == "torch":
        monkeypatch.setattr(compiled, "nearest", lambda *_: None)
    queries = torch.randn(2, 6, 3, dtype=dtype, generator=rng)
    points = torch.randn(2, n, 3, dtype=dtype, generator=rng)
    distances, indices = nearest(queries, points)
    expected, places = plain_nearest(queries, points)
    assert distances.dtype == dtype
    assert torch.equal(indices, places)
    torch.testing.assert_close(distances, expected)


def test_nearest_gradients_equal_double_loop(rng):
    def gradients(function):
        leaves = [values.clone().requires_grad_() for values in (queries, points)]
        (function(*leaves)[0] * weights).sum().backward()
        return [leaf.grad for leaf in leaves]

    queries, points = torch.randn(2, 2, 9, 3, dtype=torch.float64, generator=rng)
    weights = torch.randn(2, 9, generator=rng)
    torch.testing.assert_close(gradients(nearest), gradients(plain_nearest))


@pytest.mark.parametrize("block", [1, 100, 1000, 1500])
def test_nearest_block_size_changes_nothing(block, rng, monkeypatch):
    queries = torch.randn(3, 11, 3, generator=rng)
    points = torch.randn(3, 40, 3, generator=rng)
    monkeypatch.setattr(compiled, "nearest", lambda *_: None)
    whole = nearest(queries, points)
    monkeypatch.setitem(search.BLOCK, "cpu", block)
    for part, expected in zip(nearest(queries, points), whole, strict=True):
        assert torch.equal(part, expected)


@pytest.mark.parametrize("offset", [0.0, 30.0])
def test_nearest_far_from_origin_has_no_cancellation(offset, rng):
    """Close points far from the origin, where |a|² + |b|² − 2⟨a, b⟩ in float32 goes wrong."""
    points = offset + 0.01 * torch.rand(2, 1500, 3, generator=rng)
    queries = points[:, :400] + 1e-4 * torch.randn(2, 400, 3, generator=rng)
    distances, indices = nearest(queries, points)
    for b in range(2):
        expected, _ = cKDTree(points[b].double().numpy()).query(queries[b].double().numpy())
        found = gather_points(points, indices)[b].double()
        exact = (queries[b].double() - found).norm(dim=1)
        torch.testing.assert_close(exact, torch.from_numpy(expected), rtol=1e-6, atol=0)
        torch.testing.assert_close(distances[b].double().sqrt(), exact, rtol=1e-5, atol=0)


@pytest.mark.parametrize("value", [float("inf"), -float("inf"), float("nan")])
def test_nearest_of_query_that_is_not_finite_is_a_row(value, rng):
    points = torch.randn(1, 33, 3, generator=rng)
    queries = points[:, :5] + 0.01
    queries[0, 2] = value
    distances, indices = nearest(queries, points)
    assert not distances[0, 2].isfinite()
    assert indices[0, [0, 1, 3, 4]].tolist() == [0, 1, 3, 4]
    assert k_nearest(queries, points, 3)[1].max() < 33


def test_nearest_of_ties_is_lowest_index():
    points = torch.tensor([[[1.0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 0]]]).repeat(1, 20, 1)
    assert nearest(torch.zeros(1, 1, 3), points)[1].item() == 2
    assert nearest(torch.tensor([[[1.0, 1, 0]]]), points)[1].item() == 0


def test_nearest_half_precision_compares_in_float32(rng):
    points = torch.randn(1, 50, 3, generator=rng).half()
    queries = torch.randn(1, 20, 3, generator=rng).half()
    distances, indices = nearest(queries, points)
    assert distances.dtype == torch.half
    assert torch.equal(indices, nearest(queries.float(), points.float())[1])


@pytest.mark.parametrize(
    ("queries", "points"), [((1, 4, 3), (2, 5, 3)), ((1, 4, 2), (1, 5, 3)), ((1, 4, 3), (1, 0, 3))]
)
def test_nearest_shape_mismatch_raises(queries, points):
    for search_ in (nearest, lambda q, p: k_nearest(q, p, 1)):
        with pytest.raises(UserError, match="points"):
            search_(torch.zeros(queries), torch.zeros(points))


@pytest.mark.parametrize("k", [1, 4, 30])
def test_k_nearest_equals_sorted_distances(k, rng):
    queries = torch.randn(2, 8, 3, dtype=torch.float64, generator=rng)
    points = torch.randn(2, 30, 3, dtype=torch.float64, generator=rng)
    distances, indices = k_nearest(queries, points, k)
    expected, places = torch.cdist(queries, points).square().sort(2)
    assert torch.equal(indices, places[..., :k])
    torch.testing.assert_close(distances, expected[..., :k])


@pytest.mark.parametrize("k", [0, 6])
def test_k_nearest_out_of_range_raises(k):
    with pytest.raises(UserError, match=rf"k must be from 1 .*N=5, got {k}"):
        k_nearest(torch.zeros(1, 2, 3), torch.zeros(1, 5, 3), k)


def plain_chamfer(points, others):
    squares = (points[:, :, None] - others[:, None]).square().sum(-1)
    return squares.min(2).values.mean(1) + squares.min(1).values.mean(1)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 7), (40, 25), (300, 900)])
def test_chamfer_equals_plain_form(n, m, rng):
    points = torch.randn(3, n, 3, dtype=torch.float64, generator=rng, requires_grad=True)
    others = torch.randn(3, m, 3, dtype=torch.float64, generator=rng, requires_grad=True)
    got, want = chamfer_distance(points, others), plain_chamfer(points, others)
    torch.testing.assert_close(got, want)
    gradients = [torch.autograd.grad(value.sum(), [points, others]) for value in (got, want)]
    torch.testing.assert_close(*gradients)
