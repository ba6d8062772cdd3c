import pytest
import torch

from mops_lightning.ops import attention, sampling_matrix
from mops_lightning.ops.sampling_matrix import SamplingMatrix


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
    """Both code paths of SᵀP; the block sizes of the streamed one divide no dimension."""
    dense = 0 if request.param == "streamed" else 2**22
    monkeypatch.setitem(attention.BLOCKS, "cpu", attention.Blocks(dense, 4, 10))
    monkeypatch.setattr(sampling_matrix, "GRAM_ROWS", 4)
    return request.param


def test_dense_equals_column_softmax():
    matrix, _ = random_matrix()
    torch.testing.assert_close(matrix.dense(), plain_dense(matrix))
    torch.testing.assert_close(matrix.dense().sum(1), torch.ones(2, 11, dtype=torch.float64))


def test_sample_equals_dense_product(path):
    matrix, points = random_matrix()
    torch.testing.assert_close(matrix.sample(points), plain_dense(matrix).mT @ points)


def test_sample_is_streamed_above_a_number_of_entries(monkeypatch):
    matrix, points = random_matrix()
    calls = []
    monkeypatch.setattr(sampling_matrix, "streamed_attention", lambda *given: calls.append(given))
    for dense in (2 * 37 * 11, 2 * 37 * 11 - 1):
        monkeypatch.setitem(attention.BLOCKS, "cpu", attention.Blocks(dense, 4, 10))
        matrix.sample(points)
    assert len(calls) == 1


def test_sample_gradients_equal_dense(path):
    matrix, points = random_matrix()
    inputs = [t.clone().requires_grad_() for t in (matrix.queries, matrix.keys, points)]
    weight = torch.randn(2, 11, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    sampled = SamplingMatrix(inputs[0], inputs[1], 0.3).sample(inputs[2])
    got = torch.autograd.grad((sampled * weight).sum(), inputs)
    plain = SamplingMatrix(inputs[0], inputs[1], 0.3).dense().mT @ inputs[2]
    want = torch.autograd.grad((plain * weight).sum(), inputs)
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a, b)


def test_sample_large_logits_do_not_overflow(path):
    matrix, points = random_matrix(tau=1e-4, dtype=torch.float32)
    sampled = matrix.sample(points)
    assert torch.isfinite(sampled).all()
    # At this temperature every column has one winner.
    winners = (matrix.keys @ matrix.queries.T).argmax(1)
    expected = points.gather(1, winners[..., None].expand(-1, -1, 3))
    torch.testing.assert_close(sampled, expected, atol=1e-3, rtol=0)


def test_sample_float32_streamed_is_as_accurate_as_dense():
    matrix, points = random_matrix(batch=1, n=5000, m=1500, c=16, tau=0.1, dtype=torch.float32)
    assert matrix.keys.shape[1] * len(matrix.queries) > attention.BLOCKS["cpu"].dense
    exact = SamplingMatrix(matrix.queries.double(), matrix.keys.double(), matrix.tau)
    logits = exact.queries @ exact.keys[0].mT / exact.tau
    # Rounding error of a logit, and so of the logarithm of a weight, in float32.
    digits = float(logits.abs().max()) * torch.finfo(torch.float32).eps
    want = exact.dense().mT @ points.double()
    streamed, plain = matrix.sample(points).double(), (matrix.dense().mT @ points).double()
    torch.testing.assert_close(streamed, want, atol=digits, rtol=0)
    torch.testing.assert_close(plain, want, atol=digits, rtol=0)
    assert (streamed - want).abs().mean() <= 1.5 * (plain - want).abs().mean()


@pytest.mark.parametrize("threshold", [0.0, 0.05, 0.3, 0.9])
def test_sparse_drops_and_renormalises(path, threshold):
    matrix, _ = random_matrix()
    dense = plain_dense(matrix)
    kept = torch.where(dense >= threshold, dense, 0)
    empty = kept.sum(1) == 0
    assert empty.any() or threshold < 0.9
    largest = torch.zeros_like(dense).scatter_(1, dense.argmax(1, keepdim=True), 1.0)
    kept = torch.where(empty[:, None], largest, kept)
    torch.testing.assert_close(matrix.sparse(threshold).to_dense(), kept / kept.sum(1, True))


def test_nonzero_counts_and_gram_equal_dense(path):
    matrix, _ = random_matrix()
    dense = plain_dense(matrix)
    counts = (dense >= 0.05).to(dense).sum(1)
    torch.testing.assert_close(matrix.nonzero_counts(0.05), counts)
    torch.testing.assert_close(matrix.gram(), dense.mT @ dense)


def test_summaries_under_autocast_are_unchanged():
    matrix, _ = random_matrix(dtype=torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        half = matrix.sparse(0.05).to_dense(), matrix.nonzero_counts(0.05), matrix.gram()
    single = matrix.sparse(0.05).to_dense(), matrix.nonzero_counts(0.05), matrix.gram()
    assert all(map(torch.equal, half, single))


def test_queries_of_every_cloud_equal_matrices_of_single_clouds(path):
    matrix, points = random_matrix()
    rng = torch.Generator().manual_seed(3)
    queries = torch.randn(2, 11, 8, dtype=torch.float64, generator=rng, requires_grad=True)
    both = SamplingMatrix(queries, matrix.keys, 0.3)
    alone = [SamplingMatrix(queries[b], matrix.keys[b : b + 1], 0.3) for b in range(2)]
    want = torch.cat([one.sample(points[b : b + 1]) for b, one in enumerate(alone)])
    torch.testing.assert_close(both.sample(points), want)
    weight = torch.randn(2, 11, 3, dtype=torch.float64, generator=rng)
    got = torch.autograd.grad((both.sample(points) * weight).sum(), queries)
    torch.testing.assert_close(got, torch.autograd.grad((want * weight).sum(), queries))
    dense = torch.cat([one.dense() for one in alone]).detach()
    torch.testing.assert_close(both.dense(), dense)
    torch.testing.assert_close(both.sparse(0.0).to_dense(), dense)
    torch.testing.assert_close(both.gram(), dense.mT @ dense)
    torch.testing.assert_close(both.nonzero_counts(0.05), (dense >= 0.05).to(dense).sum(1))
    torch.testing.assert_close(both.leftmost(4).dense(), dense[..., :4])
    torch.testing.assert_close(both.first_cloud().dense(), dense[:1])
    assert both.leftmost(4).m == 4


def test_leftmost_is_first_columns_and_first_cloud_has_all():
    matrix, points = random_matrix()
    torch.testing.assert_close(matrix.leftmost(4).dense(), matrix.dense()[:, :, :4])
    torch.testing.assert_close(matrix.leftmost(4).sample(points), matrix.sample(points)[:, :4])
    torch.testing.assert_close(matrix.first_cloud().dense(), matrix.dense()[:1])
