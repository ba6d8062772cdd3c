import pytest
import torch

from mops_lightning.losses.overlap import overlap_losses
from mops_lightning.ops.sampling_matrix import SamplingMatrix


def plain(matrix, m):
    """Loop over clouds and pairs of columns."""
    values = []
    for cloud in matrix.dense()[..., :m]:
        pairs = [(i, j) for i in range(m) for j in range(m) if i != j]
        values.append(sum((cloud[:, i] @ cloud[:, j]) ** 2 for i, j in pairs) / m)
    return torch.stack([torch.as_tensor(value) for value in values]).mean()


@pytest.mark.parametrize("per_cloud", [False, True])
def test_overlap_losses_equal_loop_over_pairs(per_cloud, rng):
    shape = (3, 7, 5) if per_cloud else (7, 5)
    queries = torch.randn(shape, dtype=torch.float64, generator=rng)
    keys = torch.randn(3, 20, 5, dtype=torch.float64, generator=rng).requires_grad_()
    queries.requires_grad_()
    matrix = SamplingMatrix(queries, keys, 0.3)
    found = overlap_losses(matrix, (2, 5, 7))
    for m, loss in found.items():
        expected = plain(matrix, m)
        torch.testing.assert_close(loss, expected)
        slopes = torch.autograd.grad(loss, (queries, keys), retain_graph=True)
        torch.testing.assert_close(slopes, torch.autograd.grad(expected, (queries, keys)))


def test_overlap_is_zero_for_columns_without_common_points():
    keys = 1e3 * torch.eye(4)[None]
    assert overlap_losses(SamplingMatrix(torch.eye(4)[:3], keys, 1.0), (1, 3)) == {1: 0, 3: 0}
    same = SamplingMatrix(torch.eye(4)[[0, 0]], keys, 1.0)
    assert overlap_losses(same, (2,)) == {2: 1}
