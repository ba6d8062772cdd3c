import pytest
import torch

from mops_lightning.ops import sampling_matrix
from mops_lightning.ops.sampling_matrix import SamplingMatrix, attend


def random_matrix(batch=2, n=37, m=11, c=8, tau=0.3, dtype=torch.float64, seed=0):
    rng = torch.Generator().manual_seed(seed)
    queries = torch.randn(m, c, generator=rng, dtype=dtype)
    keys = torch.randn(batch, n, c, generator=rng, dtype=dtype)
    points = torch.randn(batch, n, 3, generator=rng, dtype=dtype)
    return SamplingMatrix(queries, keys, tau), points


def plain_dense(matrix):
    """The paper's Eq. (5), entry by entry."""
    batch, n, _ = matrix.keys.shape
    result = torch.empty(batch, n, len(matrix.queries), dtype=matrix.keys.dtype)
    for b in range(batch):
        for j, query in enumerate(matrix.queries):
            logits = torch.stack([(query * key).sum() / matrix.tau for key in matrix.keys[b]])
            shares = (logits - logits.max()).exp()
            result[b, :, j] = shares / shares.sum()
    return result


@pytest.fixture(params=["dense", "streamed"])
def path(request, monkeypatch):
    """Both ways to SᵀP, the streamed one with blocks that divide nothing evenly."""
    dense = 0 if request.param == "streamed" else 2**22
    monkeypatch.setitem(sampling_matrix.BLOCKS, "cpu", sampling_matrix.Blocks(dense, 4, 10))
    monkeypatch.setattr(sampling_matrix, "GRAM_ROWS", 4)
    return request.param


def test_dense_is_the_paper_s_column_softmax():
    matrix, _ = random_matrix()
    torch.testing.assert_close(matrix.dense(), plain_dense(matrix))
    torch.testing.assert_close(matrix.dense().sum(1), torch.ones(2, 11, dtype=torch.float64))


def test_sample_equals_transposed_dense_times_points(path):
    matrix, points = random_matrix()
    torch.testing.assert_close(matrix.sample(points), plain_dense(matrix).mT @ points)


def test_gradients_of_sample_equal_those_of_dense(path):
    matrix, points = random_matrix()
    inputs = [t.clone().requires_grad_() for t in (matrix.queries, matrix.keys, points)]
    weight = torch.randn(2, 11, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    sampled = SamplingMatrix(inputs[0], inputs[1], 0.3).sample(inputs[2])
    got = torch.autograd.grad((sampled * weight).sum(), inputs)
    plain = SamplingMatrix(inputs[0], inputs[1], 0.3).dense().mT @ inputs[2]
    want = torch.autograd.grad((plain * weight).sum(), inputs)
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a, b)


def test_gradcheck(path):
    matrix, points = random_matrix(batch=1, n=13, m=5, c=3)
    inputs = [t.clone().requires_grad_() for t in (matrix.queries, matrix.keys, points)]
    assert torch.autograd.gradcheck(
        lambda q, k, p: SamplingMatrix(q, k, 0.5).sample(p), inputs, fast_mode=False
    )


def test_sample_survives_logits_that_overflow_without_a_running_maximum(path):
    matrix, points = random_matrix(tau=1e-4, dtype=torch.float32)
    sampled = matrix.sample(points)
    assert torch.isfinite(sampled).all()
    # At this temperature every column has one winner.
    winners = (matrix.keys @ matrix.queries.T).argmax(1)
    torch.testing.assert_close(
        sampled, points.gather(1, winners[..., None].expand(-1, -1, 3)), atol=1e-3, rtol=0
    )


@pytest.mark.parametrize("height", [-50.0, 30.0, 100.0, 3e4])
def test_points_far_above_all_that_were_looked_at_first_are_weighed_rightly(height):
    matrix, points = random_matrix(batch=1, n=3000, m=5, tau=1.0, dtype=torch.float32)
    keys = matrix.keys[0].clone()
    # Rows 1 and 2 are no probes, for these are some 46 rows apart and begin with row 0.
    keys[1] = matrix.queries[3] * height / matrix.queries[3].square().sum()
    keys[2] = keys[1] * 0.999
    found = attend(matrix.queries, keys, points[0])
    logits = matrix.queries.double() @ keys.double().mT
    want = logits.softmax(1) @ points[0].double()
    torch.testing.assert_close(found.result().double(), want, rtol=1e-4, atol=1e-5)
    parts = [
        attend(matrix.queries, keys[rows], points[0, rows])
        for rows in (slice(0, 1), slice(1, 2), slice(2, 3000))
    ]
    merged = parts[0].merge(parts[1]).merge(parts[2])
    torch.testing.assert_close(merged.result(), found.result(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_halves_overflow_nowhere(dtype):
    matrix, points = random_matrix(batch=1, n=3000, m=50, tau=0.2, dtype=torch.float32)
    found = attend(matrix.queries.to(dtype) / 0.2, matrix.keys[0].to(dtype), points[0].to(dtype))
    logits = (matrix.queries.to(dtype) / 0.2).double() @ matrix.keys[0].to(dtype).double().mT
    want = logits.softmax(1) @ points[0].double()
    digits = float(logits.abs().max()) * torch.finfo(dtype).eps
    torch.testing.assert_close(found.result().double(), want, rtol=0, atol=2 * digits)


def test_logits_without_digits_give_points_of_the_cloud_s_size():
    matrix, points = random_matrix(batch=1, n=1500, m=300, c=257, dtype=torch.float32)
    found = attend(matrix.queries * 1e8, matrix.keys[0].relu(), points[0])
    # Which point wins is chance, for logits of 1e9 are whole hundreds; a number it must be.
    assert found.result().abs().max() <= points.abs().max() * 1.001
    assert found.total.min() >= 0.5


def test_sums_over_many_points_keep_their_digits(rng):
    queries, keys = torch.zeros(3, 4), torch.zeros(300_000, 4)
    values = torch.rand(300_000, 3, generator=rng)
    found = attend(queries, keys, values).result()
    torch.testing.assert_close(
        found, values.double().mean(0).float().expand(3, 3), rtol=1e-6, atol=0
    )


def test_streamed_equals_dense_in_float32_at_real_sizes():
    matrix, points = random_matrix(batch=1, n=5000, m=1500, c=16, tau=0.1, dtype=torch.float32)
    assert matrix.keys.shape[1] * len(matrix.queries) > sampling_matrix.BLOCKS["cpu"].dense
    exact = SamplingMatrix(matrix.queries.double(), matrix.keys.double(), matrix.tau)
    logits = exact.queries @ exact.keys[0].mT / exact.tau
    # Float32 holds a logit, and so the logarithm of a share, to this.
    digits = float(logits.abs().max()) * torch.finfo(torch.float32).eps
    want = exact.dense().mT @ points.double()
    streamed, plain = matrix.sample(points).double(), (matrix.dense().mT @ points).double()
    torch.testing.assert_close(streamed, want, atol=digits, rtol=0)
    torch.testing.assert_close(plain, want, atol=digits, rtol=0)
    assert (streamed - want).abs().mean() <= 1.5 * (plain - want).abs().mean()


def test_sparse_at_threshold_zero_is_dense(path):
    matrix, _ = random_matrix()
    torch.testing.assert_close(matrix.sparse(0.0).to_dense(), plain_dense(matrix))


@pytest.mark.parametrize("threshold", [0.05, 0.3, 0.9])
def test_sparse_drops_renormalises_and_leaves_no_column_empty(path, threshold):
    matrix, _ = random_matrix()
    dense = plain_dense(matrix)
    kept = torch.where(dense >= threshold, dense, 0)
    empty = kept.sum(1) == 0
    assert empty.any() or threshold < 0.9
    largest = torch.zeros_like(dense).scatter_(1, dense.argmax(1, keepdim=True), 1.0)
    kept = torch.where(empty[:, None], largest, kept)
    torch.testing.assert_close(matrix.sparse(threshold).to_dense(), kept / kept.sum(1, True))


def test_statistics_equal_those_of_dense(path):
    matrix, _ = random_matrix()
    dense = plain_dense(matrix)
    counts = (dense >= 0.05).to(dense).sum(1)
    torch.testing.assert_close(matrix.nonzero_counts(0.05), counts)
    torch.testing.assert_close(matrix.gram(), dense.mT @ dense)


def test_leftmost_columns_are_the_first_queries():
    matrix, points = random_matrix()
    torch.testing.assert_close(matrix.leftmost(4).dense(), matrix.dense()[:, :, :4])
    torch.testing.assert_close(matrix.leftmost(4).sample(points), matrix.sample(points)[:, :4])


def test_order_of_points_does_not_matter(path, rng):
    matrix, points = random_matrix()
    order = torch.randperm(37, generator=rng)
    shuffled = matrix._replace(keys=matrix.keys[:, order])
    torch.testing.assert_close(shuffled.sample(points[:, order]), matrix.sample(points))
