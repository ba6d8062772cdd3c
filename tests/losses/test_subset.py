import itertools
from statistics import mean

import pytest
import torch
from torch.testing import assert_close

from mops_lightning.losses.subset import overlap_losses, simplification_losses, subset_losses
from mops_lightning.ops.sampling_matrix import SamplingMatrix
from tests.support.losses import simplification_loss, subset_loss
from tests.support.plain import squared


def test_subset_loss_equals_double_loop(randn):
    points = randn(3, 12, 3, dtype=torch.float64)
    samples = randn(3, 5, 3, dtype=torch.float64, requires_grad=True)

    def loss_of(samples):
        return subset_loss(points, samples)

    loss = loss_of(samples)

    distances = []
    for cloud, sample in zip(points, samples, strict=True):
        distances += plain_nearest(sample, cloud)
    expected = torch.stack(distances).mean()
    assert_close(loss, expected)
    gradient = torch.autograd.grad(loss, samples)
    expected_gradient = torch.autograd.grad(expected, samples)
    assert_close(gradient, expected_gradient)
    assert torch.autograd.gradcheck(loss_of, (samples,))


def test_subset_loss_of_input_points_is_zero(randn):
    points = randn(3, 12, 3, dtype=torch.float64)
    assert subset_loss(points, points[:, 3:7]) == 0


def plain_simplification_loss(points, samples, coverage, per_point):
    """The loss as published, one number at a time."""
    total = 0.0
    for cloud, sample in zip(points, samples, strict=True):
        to_cloud = [float(distance) for distance in plain_nearest(sample, cloud)]
        from_cloud = [float(distance) for distance in plain_nearest(cloud, sample)]
        weight = coverage + per_point * len(sample)
        total += mean(to_cloud)
        total += max(to_cloud)
        total += weight * mean(from_cloud)
    return total / len(points)


def plain_nearest(points, others):
    """Return the squared distance of each point to the nearest of the others."""
    nearest = []
    for point in points:
        distances = [squared(point, other) for other in others]
        nearest.append(min(distances))
    return nearest


@pytest.mark.parametrize(
    ("coverage", "per_point"),
    [
        (1.0, 0.0),
        (0.5, 1 / 30),
        (0.0, 1 / 64),
    ],
)
def test_simplification_loss_equals_double_loop(coverage, per_point, randn):
    points = randn(3, 17, 3)
    samples = randn(3, 5, 3)

    value = simplification_loss(points, samples, coverage, per_point)

    expected = plain_simplification_loss(points, samples, coverage, per_point)
    assert float(value) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("losses", "loss", "weights"),
    [
        (subset_losses, subset_loss, ()),
        (simplification_losses, simplification_loss, (0.5, 0.1)),
    ],
)
def test_losses_of_several_sizes_equal_each_size(losses, loss, weights, randn):
    points = randn(3, 30, 3, dtype=torch.float64)
    samples = randn(3, 12, 3, dtype=torch.float64, requires_grad=True)
    sizes = (12, 1, 5)

    together = losses(points, samples, sizes, *weights)

    assert set(together) == set(sizes)
    for m in sizes:
        first = samples[:, :m].clone()
        alone = loss(points, first, *weights)
        assert_close(together[m], alone)
        gradient = torch.autograd.grad(together[m], samples, retain_graph=True)
        gradient_alone = torch.autograd.grad(alone, samples)
        assert_close(gradient, gradient_alone)


def test_simplification_loss_has_weights_of_one_and_zero_by_default(randn):
    points = randn(3, 17, 3)
    samples = randn(3, 5, 3)

    value = simplification_loss(points, samples)

    expected = plain_simplification_loss(points, samples, 1.0, 0.0)
    assert float(value) == pytest.approx(expected, rel=1e-5)


def plain_overlap(matrix, m):
    """Loop over clouds and pairs of columns."""
    clouds = matrix.dense()[..., :m]
    total = torch.zeros((), dtype=clouds.dtype)
    for cloud in clouds:
        for i, j in itertools.permutations(range(m), 2):
            product = cloud[:, i] @ cloud[:, j]
            total = total + product**2
    return total / m / len(clouds)


@pytest.mark.parametrize("per_cloud", [False, True])
def test_overlap_losses_equal_loop_over_pairs(per_cloud, randn):
    clouds = (3,) if per_cloud else ()
    queries = randn(*clouds, 7, 5, dtype=torch.float64, requires_grad=True)
    keys = randn(3, 20, 5, dtype=torch.float64, requires_grad=True)
    matrix = SamplingMatrix(queries, keys, 0.3)

    losses = overlap_losses(matrix, (2, 7, 5))

    assert list(losses) == [2, 7, 5]
    for m, loss in losses.items():
        expected = plain_overlap(matrix, m)
        assert_close(loss, expected)
        gradients = torch.autograd.grad(loss, (queries, keys), retain_graph=True)
        expected_gradients = torch.autograd.grad(expected, (queries, keys))
        assert_close(gradients, expected_gradients)


def test_overlap_is_zero_for_columns_without_common_points():
    unit = torch.eye(4)
    keys = 1e3 * unit[None]
    different = SamplingMatrix(unit[:3], keys, 1.0)
    same = SamplingMatrix(unit[[0, 0]], keys, 1.0)

    assert overlap_losses(different, (1, 3)) == {1: 0, 3: 0}
    assert overlap_losses(same, (2,)) == {2: 1}
