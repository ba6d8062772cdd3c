import pytest
import torch

from mops_lightning.losses.subset import overlap_losses, simplification_losses, subset_losses
from mops_lightning.ops.sampling_matrix import SamplingMatrix
from tests.support.losses import simplification_loss, subset_loss
from tests.support.plain import squared


def test_subset_loss_equals_double_loop(rng):
    points = torch.randn(3, 12, 3, dtype=torch.float64, generator=rng)
    samples = torch.randn(3, 5, 3, dtype=torch.float64, generator=rng, requires_grad=True)
    expected = torch.tensor(0.0, dtype=torch.float64)
    for cloud, sample in zip(points, samples, strict=True):
        for q in sample:
            expected = expected + min(squared(q, p) for p in cloud) / 5 / 3
    loss = subset_loss(points, samples)
    torch.testing.assert_close(loss, expected)
    slopes = torch.autograd.grad(expected, samples)
    torch.testing.assert_close(torch.autograd.grad(loss, samples), slopes)
    assert torch.autograd.gradcheck(lambda q: subset_loss(points, q), (samples,))


def test_subset_loss_of_input_points_is_zero(rng):
    points = torch.randn(3, 12, 3, dtype=torch.float64, generator=rng)
    assert subset_loss(points, points[:, 3:7]) == 0


def plain_simplification_loss(points, samples, coverage, per_point):
    """The loss as published, one number at a time."""
    total = 0.0
    for cloud, sample in zip(points, samples, strict=True):
        to_cloud = [min(float((q - p).square().sum()) for p in cloud) for q in sample]
        from_cloud = [min(float((q - p).square().sum()) for q in sample) for p in cloud]
        weight = coverage + per_point * len(to_cloud)
        mean = sum(to_cloud) / len(to_cloud)
        total += mean + max(to_cloud) + weight * sum(from_cloud) / len(from_cloud)
    return total / len(points)


@pytest.mark.parametrize(("coverage", "per_point"), [(1.0, 0.0), (0.5, 1 / 30), (0.0, 1 / 64)])
def test_simplification_loss_equals_double_loop(coverage, per_point, rng):
    points = torch.randn(3, 17, 3, generator=rng)
    samples = torch.randn(3, 5, 3, generator=rng)
    value = float(simplification_loss(points, samples, coverage, per_point))
    expected = plain_simplification_loss(points, samples, coverage, per_point)
    assert value == pytest.approx(expected, rel=1e-5)
    default = plain_simplification_loss(points, samples, 1.0, 0.0)
    assert float(simplification_loss(points, samples)) == pytest.approx(default, rel=1e-5)


@pytest.mark.parametrize(
    ("losses", "loss", "weights"),
    [(subset_losses, subset_loss, ()), (simplification_losses, simplification_loss, (0.5, 0.1))],
)
def test_losses_of_several_sizes_equal_each_size(losses, loss, weights, rng):
    points = torch.randn(3, 30, 3, generator=rng, dtype=torch.float64)
    samples = torch.randn(3, 12, 3, generator=rng, dtype=torch.float64, requires_grad=True)
    sizes = (12, 1, 5)
    together = losses(points, samples, sizes, *weights)
    assert set(together) == set(sizes)
    for m in sizes:
        alone = loss(points, samples[:, :m].clone(), *weights)
        torch.testing.assert_close(together[m], alone)
        (got,) = torch.autograd.grad(together[m], samples, retain_graph=True)
        (want,) = torch.autograd.grad(alone, samples)
        torch.testing.assert_close(got, want)


def plain_overlap(matrix, m):
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
        expected = plain_overlap(matrix, m)
        torch.testing.assert_close(loss, expected)
        slopes = torch.autograd.grad(loss, (queries, keys), retain_graph=True)
        torch.testing.assert_close(slopes, torch.autograd.grad(expected, (queries, keys)))


def test_overlap_is_zero_for_columns_without_common_points():
    keys = 1e3 * torch.eye(4)[None]
    assert overlap_losses(SamplingMatrix(torch.eye(4)[:3], keys, 1.0), (1, 3)) == {1: 0, 3: 0}
    same = SamplingMatrix(torch.eye(4)[[0, 0]], keys, 1.0)
    assert overlap_losses(same, (2,)) == {2: 1}
