import pytest
import torch
from torch.testing import assert_close

from mops_lightning.ops import attention, sampling_matrix
from mops_lightning.ops.local_matrix import LocalMatrix
from mops_lightning.ops.sampling_matrix import SamplingMatrix


def drawn_normal(rng, *shape, dtype=torch.float64):
    return torch.randn(shape, generator=rng, dtype=dtype)


def random_matrix(batch=2, n=37, m=11, c=8, tau=0.3, dtype=torch.float64, seed=0):
    rng = torch.Generator().manual_seed(seed)
    queries = drawn_normal(rng, m, c, dtype=dtype)
    keys = drawn_normal(rng, batch, n, c, dtype=dtype)
    points = drawn_normal(rng, batch, n, 3, dtype=dtype)
    matrix = SamplingMatrix(queries, keys, tau)
    return matrix, points


def plain_dense(matrix):
    """The paper's Eq. (5), entry by entry."""
    clouds = []
    for keys in matrix.keys:
        columns = []
        for query in matrix.queries:
            products = [(query * key).sum() for key in keys]
            logits = torch.stack(products) / matrix.tau
            shares = (logits - logits.max()).exp()
            columns.append(shares / shares.sum())
        clouds.append(torch.stack(columns, 1))
    return torch.stack(clouds)


@pytest.fixture(params=["dense", "streamed"])
def path(request, monkeypatch):
    """Both code paths of SᵀP; the block sizes of the streamed one divide no dimension."""
    dense = 0 if request.param == "streamed" else 2**22
    monkeypatch.setitem(attention.BLOCKS, "cpu", attention.Blocks(dense, 4, 10))
    monkeypatch.setattr(sampling_matrix, "GRAM_ROWS", 4)
    return request.param


def test_dense_equals_column_softmax():
    matrix, _ = random_matrix()

    dense = matrix.dense()

    ones = torch.ones(2, 11, dtype=torch.float64)
    assert_close(dense, plain_dense(matrix))
    assert_close(dense.sum(1), ones)


def test_sample_equals_dense_product(path):
    matrix, points = random_matrix()

    sampled = matrix.sample(points)

    expected = plain_dense(matrix).mT @ points
    assert_close(sampled, expected)


def test_sample_is_streamed_above_a_number_of_entries(monkeypatch):
    matrix, points = random_matrix()
    entries = 2 * 37 * 11
    calls = []

    def note_call(*given):
        calls.append(given)

    monkeypatch.setattr(sampling_matrix, "streamed_attention", note_call)

    monkeypatch.setitem(attention.BLOCKS, "cpu", attention.Blocks(entries, 4, 10))
    matrix.sample(points)
    assert len(calls) == 0

    monkeypatch.setitem(attention.BLOCKS, "cpu", attention.Blocks(entries - 1, 4, 10))
    matrix.sample(points)
    assert len(calls) == 1


def test_sample_gradients_equal_dense(path):
    matrix, points = random_matrix()
    queries = matrix.queries.clone().requires_grad_()
    keys = matrix.keys.clone().requires_grad_()
    points.requires_grad_()
    inputs = (queries, keys, points)
    direction = drawn_normal(torch.Generator().manual_seed(5), 2, 11, 3)
    differentiable = SamplingMatrix(queries, keys, 0.3)

    sampled = differentiable.sample(points)

    plain = differentiable.dense().mT @ points
    gradients = torch.autograd.grad(sampled, inputs, direction)
    expected = torch.autograd.grad(plain, inputs, direction)
    assert_close(gradients, expected)


def test_sample_large_logits_do_not_overflow(path):
    matrix, points = random_matrix(tau=1e-4, dtype=torch.float32)

    sampled = matrix.sample(points)

    assert torch.isfinite(sampled).all()
    # At this temperature every column has one winner.
    logits = matrix.keys @ matrix.queries.T
    winners = logits.argmax(1)
    expected = torch.take_along_dim(points, winners[..., None], 1)
    assert_close(sampled, expected, atol=1e-3, rtol=0)


def test_sample_float32_streamed_is_as_accurate_as_dense():
    matrix, points = random_matrix(batch=1, n=5000, m=1500, c=16, tau=0.1, dtype=torch.float32)
    entries = 5000 * 1500
    assert entries > attention.BLOCKS["cpu"].dense
    queries = matrix.queries.double()
    keys = matrix.keys.double()
    exact = SamplingMatrix(queries, keys, matrix.tau)
    expected = exact.dense().mT @ points.double()

    streamed = matrix.sample(points)
    plain = matrix.dense().mT @ points

    # Rounding error of a logit, and so of the logarithm of a weight, in float32.
    logits = queries @ keys[0].mT / matrix.tau
    largest_logit = logits.abs().max().item()
    tolerance = largest_logit * torch.finfo(torch.float32).eps
    error_of_streamed = (streamed.double() - expected).abs()
    error_of_plain = (plain.double() - expected).abs()
    assert error_of_streamed.max() <= tolerance
    assert error_of_plain.max() <= tolerance
    assert error_of_streamed.mean() <= 1.5 * error_of_plain.mean()


@pytest.mark.parametrize("threshold", [0.0, 0.05, 0.3, 0.9])
def test_sparse_drops_and_renormalises(path, threshold):
    matrix, _ = random_matrix()
    dense = plain_dense(matrix)
    kept = torch.where(dense >= threshold, dense, 0)
    is_empty = kept.sum(1, keepdim=True) == 0
    assert is_empty.any() or threshold < 0.9
    largest_rows = dense.argmax(1, keepdim=True)
    largest = torch.zeros_like(dense).scatter_(1, largest_rows, 1.0)
    kept = torch.where(is_empty, largest, kept)
    expected = kept / kept.sum(1, keepdim=True)

    sparse = matrix.sparse(threshold)

    assert_close(sparse.to_dense(), expected)


def test_entries_count_from_a_hundredth_unless_another_threshold_is_given():
    shares = torch.tensor([0.008, 0.012, 0.98])
    full = SamplingMatrix(shares.log()[None], torch.eye(3)[None], 1.0)
    local = LocalMatrix(shares.view(1, 1, 3), torch.tensor([[[0, 1, 2]]]), 3)

    for matrix in (full, local):
        assert matrix.nonzero_counts().tolist() == [[2.0]]
        large, small = (0.98 / 0.992, 0.012 / 0.992)
        (sparse,) = matrix.sparse().to_dense()
        assert sparse[:, 0].tolist() == pytest.approx([0, small, large])


def test_nonzero_counts_and_gram_equal_dense(path):
    matrix, _ = random_matrix()

    counts = matrix.nonzero_counts(0.05)
    gram = matrix.gram()

    dense = plain_dense(matrix)
    is_large = dense >= 0.05
    assert_close(counts, is_large.double().sum(1))
    assert_close(gram, dense.mT @ dense)


def summaries(matrix):
    """Return the sparse matrix, the numbers of its entries and the Gram matrix."""
    return matrix.sparse(0.05).to_dense(), matrix.nonzero_counts(0.05), matrix.gram()


def test_summaries_under_autocast_are_unchanged():
    matrix, _ = random_matrix(dtype=torch.float32)

    with torch.autocast("cpu", torch.bfloat16):
        under_autocast = summaries(matrix)

    single = summaries(matrix)
    assert_close(under_autocast, single, atol=0, rtol=0)


@pytest.fixture
def matrix_per_cloud():
    """Two clouds with queries of their own, as one matrix and as two."""
    matrix, points = random_matrix()
    rng = torch.Generator().manual_seed(3)
    queries = drawn_normal(rng, 2, 11, 8).requires_grad_()
    together = SamplingMatrix(queries, matrix.keys, 0.3)
    first = SamplingMatrix(queries[0], matrix.keys[:1], 0.3)
    second = SamplingMatrix(queries[1], matrix.keys[1:], 0.3)
    return together, first, second, points


def test_samples_with_queries_of_every_cloud_equal_those_of_single_clouds(path, matrix_per_cloud):
    together, first, second, points = matrix_per_cloud
    of_first = first.sample(points[:1])
    of_second = second.sample(points[1:])
    expected = torch.cat([of_first, of_second])

    sampled = together.sample(points)

    assert_close(sampled, expected)
    direction = drawn_normal(torch.Generator().manual_seed(4), 2, 11, 3)
    gradient = torch.autograd.grad(sampled, together.queries, direction)
    expected_gradient = torch.autograd.grad(expected, together.queries, direction)
    assert_close(gradient, expected_gradient)


def test_views_with_queries_of_every_cloud_equal_those_of_single_clouds(path, matrix_per_cloud):
    together, first, second, _ = matrix_per_cloud
    dense = torch.cat([first.dense(), second.dense()]).detach()
    is_large = dense >= 0.05
    leftmost = together.leftmost(4)

    assert_close(together.dense(), dense)
    assert_close(together.sparse(0.0).to_dense(), dense)
    assert_close(together.gram(), dense.mT @ dense)
    assert_close(together.nonzero_counts(0.05), is_large.to(dense).sum(1))
    assert_close(leftmost.dense(), dense[..., :4])
    assert_close(together.first_cloud().dense(), dense[:1])
    assert leftmost.m == 4


def test_leftmost_is_first_columns_and_first_cloud_has_all():
    matrix, points = random_matrix()
    dense = matrix.dense()
    sampled = matrix.sample(points)

    leftmost = matrix.leftmost(4)
    first_cloud = matrix.first_cloud()

    assert_close(leftmost.dense(), dense[:, :, :4])
    assert_close(leftmost.sample(points), sampled[:, :4])
    assert_close(first_cloud.dense(), dense[:1])
