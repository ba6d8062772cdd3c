"""Nearest points and the chamfer distance against double loops, SciPy and torch."""

from functools import partial

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch.testing import assert_close

from mops_lightning.errors import UserError
from mops_lightning.ops import compiled
from mops_lightning.ops import nearest as search
from mops_lightning.ops.nearest import chamfer_distance, k_nearest, nearest, nearest_features
from tests.support.plain import plain_nearest


@pytest.fixture
def without_compiled_loops(monkeypatch):
    """Leave the search to torch."""

    def no_result(*_):
        return None

    monkeypatch.setattr(compiled, "nearest", no_result)


def check_against_double_loop(n, dtype, rng):
    queries = torch.randn(2, 6, 3, dtype=dtype, generator=rng)
    points = torch.randn(2, n, 3, dtype=dtype, generator=rng)

    distances, indices = nearest(queries, points)

    expected_distances, expected_indices = plain_nearest(queries, points)
    assert distances.dtype == dtype
    assert torch.equal(indices, expected_indices)
    assert_close(distances, expected_distances)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [5, 32, 75])
def test_nearest_equals_double_loop(n, dtype, rng):
    check_against_double_loop(n, dtype, rng)


@pytest.mark.usefixtures("without_compiled_loops")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [5, 32, 75])
def test_nearest_in_torch_equals_double_loop(n, dtype, rng):
    check_against_double_loop(n, dtype, rng)


def gradients(search_, queries, points, weights):
    """Return the gradients of a weighted sum of distances."""
    queries = queries.clone().requires_grad_()
    points = points.clone().requires_grad_()
    distances, _ = search_(queries, points)
    return torch.autograd.grad(distances, [queries, points], weights)


def test_nearest_gradients_equal_double_loop(randn):
    queries = randn(2, 9, 3, dtype=torch.float64)
    points = randn(2, 9, 3, dtype=torch.float64)
    weights = randn(2, 9, dtype=torch.float64)

    of_nearest = gradients(nearest, queries, points, weights)

    of_plain = gradients(plain_nearest, queries, points, weights)
    assert_close(of_nearest, of_plain)


@pytest.mark.usefixtures("without_compiled_loops")
@pytest.mark.parametrize("block", [1, 100, 1000, 1500])
def test_nearest_block_size_changes_nothing(block, randn, monkeypatch):
    queries = randn(3, 11, 3)
    points = randn(3, 40, 3)
    whole_distances, whole_indices = nearest(queries, points)
    monkeypatch.setitem(search.BLOCK, "cpu", block)

    distances, indices = nearest(queries, points)

    assert torch.equal(distances, whole_distances)
    assert torch.equal(indices, whole_indices)


@pytest.mark.parametrize("offset", [0.0, 30.0])
@pytest.mark.parametrize("cloud", [0, 1])
def test_nearest_far_from_origin_has_no_cancellation(cloud, offset, randn, rand):
    """Close points far from the origin, where |a|² + |b|² − 2⟨a, b⟩ in float32 goes wrong."""
    points = offset + 0.01 * rand(2, 1500, 3)
    noise = 1e-4 * randn(2, 400, 3)
    queries = points[:, :400] + noise

    distances, indices = nearest(queries, points)

    exact_points = points[cloud].double().numpy()
    exact_queries = queries[cloud].double().numpy()
    smallest, _ = cKDTree(exact_points).query(exact_queries)
    nearest_points = exact_points[indices[cloud]]
    offsets = exact_queries - nearest_points
    exact = np.linalg.norm(offsets, axis=1)
    squares = distances[cloud].double()
    returned = squares.sqrt().numpy()
    assert exact == pytest.approx(smallest, rel=1e-6)
    assert returned == pytest.approx(exact, rel=1e-5)


@pytest.mark.parametrize("value", [torch.inf, -torch.inf, torch.nan])
def test_nearest_of_query_that_is_not_finite_is_a_row(value, randn):
    points = randn(1, 33, 3)
    queries = points[:, :5] + 0.01
    queries[0, 2] = value
    finite = [0, 1, 3, 4]

    distances, indices = nearest(queries, points)
    _, near_indices = k_nearest(queries, points, 3)

    is_finite = distances[0].isfinite().tolist()
    rows = indices[0, finite].tolist()
    assert is_finite == [True, True, False, True, True]
    assert rows == finite
    assert near_indices.max() < 33


@pytest.mark.parametrize(
    ("query", "row"),
    [
        ([0.0, 0.0, 0.0], 2),
        ([1.0, 1.0, 0.0], 0),
    ],
)
def test_nearest_of_ties_is_lowest_index(query, row):
    four_points = [
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0],
    ]
    twenty_times = 20 * four_points
    points = torch.tensor([twenty_times])
    queries = torch.tensor([[query]])

    _, indices = nearest(queries, points)

    assert indices.item() == row


def test_nearest_half_precision_compares_in_float32(randn):
    points = randn(1, 50, 3).half()
    queries = randn(1, 20, 3).half()

    distances, indices = nearest(queries, points)

    queries_in_single = queries.float()
    points_in_single = points.float()
    _, expected = nearest(queries_in_single, points_in_single)
    assert distances.dtype == torch.half
    assert torch.equal(indices, expected)


MISMATCHES = [
    pytest.param((1, 4, 3), (2, 5, 3), id="other-number-of-clouds"),
    pytest.param((1, 4, 2), (1, 5, 3), id="two-coordinates"),
    pytest.param((1, 4, 3), (1, 0, 3), id="no-points"),
]


@pytest.mark.parametrize(("shape_of_queries", "shape_of_points"), MISMATCHES)
def test_nearest_shape_mismatch_raises(shape_of_queries, shape_of_points):
    queries = torch.zeros(shape_of_queries)
    points = torch.zeros(shape_of_points)

    with pytest.raises(UserError, match="points"):
        nearest(queries, points)


def test_nearest_of_moved_points_are_the_points_themselves(rand):
    points = rand(2, 40, 3)

    squared, rows = nearest(points + 1e-4, points)

    every_row = list(range(40))
    assert rows.tolist() == [every_row, every_row]
    assert squared.sqrt().max() < 1e-3


@pytest.mark.parametrize(("shape_of_queries", "shape_of_points"), MISMATCHES)
def test_k_nearest_shape_mismatch_raises(shape_of_queries, shape_of_points):
    queries = torch.zeros(shape_of_queries)
    points = torch.zeros(shape_of_points)

    with pytest.raises(UserError, match="points"):
        k_nearest(queries, points, 1)


@pytest.mark.parametrize("k", [1, 4, 30])
def test_k_nearest_equals_sorted_distances(k, randn):
    queries = randn(2, 8, 3, dtype=torch.float64)
    points = randn(2, 30, 3, dtype=torch.float64)

    distances, indices = k_nearest(queries, points, k)

    squared = torch.cdist(queries, points).square()
    in_order, rows = squared.sort(2)
    expected_distances = in_order[..., :k]
    expected_indices = rows[..., :k]
    assert torch.equal(indices, expected_indices)
    assert_close(distances, expected_distances)


@pytest.mark.parametrize("k", [0, 6])
def test_k_nearest_out_of_range_raises(k):
    queries = torch.zeros(1, 2, 3)
    points = torch.zeros(1, 5, 3)

    with pytest.raises(UserError, match=rf"k must be from 1 .*N=5, got {k}"):
        k_nearest(queries, points, k)


def check_features_against_plain_distances(k, channels, rng):
    features = torch.randn(2, 40, channels, generator=rng)

    rows = nearest_features(features, k)

    squares = (features[:, :, None] - features[:, None]).double().square().sum(3)
    expected = squares.argsort(2)[..., :k]
    assert torch.equal(rows, expected)


@pytest.mark.parametrize("channels", [3, 64])
@pytest.mark.parametrize("k", [1, 4, 16])
def test_nearest_features_equal_plain_distances(k, channels, rng):
    check_features_against_plain_distances(k, channels, rng)


@pytest.mark.usefixtures("without_compiled_loops")
@pytest.mark.parametrize("channels", [3, 64])
@pytest.mark.parametrize("k", [1, 4, 16])
def test_nearest_features_by_product_equal_plain_distances(k, channels, rng):
    check_features_against_plain_distances(k, channels, rng)


def test_nearest_features_equal_those_of_a_tree(rng):
    features = torch.randn(1, 300, 8, generator=rng)

    (rows,) = nearest_features(features, 12)

    _, expected = cKDTree(features[0].numpy()).query(features[0].numpy(), 12)
    assert np.array_equal(rows.numpy(), expected)


def test_nearest_features_of_equal_points_are_the_lowest_rows():
    features = torch.tensor([[[1.0, 2.0]] * 3 + [[5.0, 5.0]] * 2])

    rows = nearest_features(features, 2)

    assert rows.tolist() == [[[0, 1], [0, 1], [0, 1], [3, 4], [3, 4]]]


def test_nearest_features_of_fewer_points_than_k_are_all_points(randn):
    rows = nearest_features(randn(2, 3, 4), 20)

    assert rows.shape == (2, 3, 3)
    assert torch.equal(rows.sort(2).values, torch.arange(3).expand(2, 3, 3))


def test_nearest_features_in_half_precision_compare_in_float32(rng):
    features = torch.randn(1, 50, 16, generator=rng).bfloat16()

    assert torch.equal(nearest_features(features, 5), nearest_features(features.float(), 5))


def plain_chamfer(points, others):
    differences = points[:, :, None] - others[:, None]
    squares = differences.square().sum(-1)
    from_points = squares.amin(2)
    from_others = squares.amin(1)
    return from_points.mean(1) + from_others.mean(1)


@pytest.mark.parametrize(
    ("n", "m"),
    [
        (1, 1),
        (1, 7),
        (40, 25),
        (300, 900),
    ],
)
def test_chamfer_equals_plain_form(n, m, randn):
    points = randn(3, n, 3, dtype=torch.float64, requires_grad=True)
    others = randn(3, m, 3, dtype=torch.float64, requires_grad=True)
    inputs = [points, others]

    distance = chamfer_distance(points, others)

    expected = plain_chamfer(points, others)
    assert_close(distance, expected)
    sum_of_clouds = distance.sum()
    expected_sum = expected.sum()
    gradients_of_sum = torch.autograd.grad(sum_of_clouds, inputs)
    expected_gradients = torch.autograd.grad(expected_sum, inputs)
    assert_close(gradients_of_sum, expected_gradients)


@pytest.mark.parametrize("function", [nearest, partial(k_nearest, k=1), chamfer_distance])
def test_nearest_of_no_points_raises(function):
    queries = torch.zeros(1, 2, 3)
    no_points = torch.zeros(1, 0, 3)

    with pytest.raises(UserError, match="points must have at least one point per cloud, got N=0"):
        function(queries, no_points)
