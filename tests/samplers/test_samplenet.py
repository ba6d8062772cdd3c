import math

import pytest
import torch
from torch.testing import assert_close

from mops_lightning.ops.nearest import k_nearest, nearest
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.samplenet import ProgressiveSampleNet, SampleNet, soft_projection
from tests.support.losses import simplification_loss


def plain_projected(query, cloud, k, sigma):
    """Project one point on its k nearest, differentiably."""
    squares = (query - cloud).square().sum(1)
    near = squares.argsort()[:k]
    weights = torch.exp(-squares[near] / sigma)
    weighted = weights[:, None] * cloud[near]
    return weighted.sum(0) / weights.sum()


def plain_projection(queries, points, k, sigma):
    """Project every point in a double loop, differentiably."""
    clouds = []
    for query_cloud, cloud in zip(queries, points, strict=True):
        projected = [plain_projected(query, cloud, k, sigma) for query in query_cloud]
        clouds.append(torch.stack(projected))
    return torch.stack(clouds)


@pytest.mark.parametrize("k", [1, 4, 11])
def test_soft_projection_equals_double_loop(k, randn):
    points = randn(2, 11, 3, dtype=torch.float64).requires_grad_()
    queries = randn(2, 5, 3, dtype=torch.float64).requires_grad_()
    sigma = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    direction = randn(2, 5, 3, dtype=torch.float64)

    fast = soft_projection(queries, points, k, sigma)

    plain = plain_projection(queries, points, k, sigma)
    assert_close(fast, plain)
    if k == 1:
        return  # the weight is 1 for any query and sigma
    inputs = [queries, points, sigma]
    gradients = torch.autograd.grad(fast, inputs, direction)
    expected = torch.autograd.grad(plain, inputs, direction)
    assert_close(gradients, expected)


def test_soft_projection_limits_are_nearest_point_and_mean(randn):
    points = randn(3, 50, 3)
    queries = randn(3, 9, 3)
    _, nearest_rows = nearest(queries, points)
    _, near_rows = k_nearest(queries, points, 7)

    sharp = soft_projection(queries, points, 7, 1e-9)
    sharpest = soft_projection(queries, points, 7, torch.tensor(1e-38))
    wide = soft_projection(queries, points, 7, 1e9)

    assert_close(sharp, gather_points(points, nearest_rows))
    assert torch.isfinite(sharpest).all()
    neighbours = gather_points(points, near_rows)
    assert_close(wide, neighbours.mean(2))


def test_samplenet_projects_in_training_only(randn):
    net = SampleNet(6, k=4, beta=0.5, alpha=3.0).train()
    points = randn(4, 20, 3)
    at_start = net(points)
    torch.nn.init.constant_(net.temperature, 0.6)

    in_training = net(points)
    in_test = net.eval()(points)

    generated = in_training.points
    sigma = 0.6**2
    projected = soft_projection(generated, points, 4, sigma)
    losses = in_training.losses
    simplification = 3 * simplification_loss(points, generated)
    assert at_start.losses["projection"] == 0.5  # sigma starts at 1²
    assert losses["projection"].item() == pytest.approx(0.5 * sigma)
    assert_close(losses["simplification"], simplification)
    assert_close(in_training.soft_projected, projected)
    assert in_test.soft_projected is None


def test_samplenet_projection_in_evaluation_equals_double_loop_with_learned_temperature(randn):
    net = SampleNet(6, k=4)
    torch.nn.init.constant_(net.temperature, 0.3)
    points = randn(2, 20, 3)
    points[:, 10:] = points[:, :10]  # duplicates tie
    generated = net.eval()(points).points

    projected = net.project(generated, points)

    assert_close(projected, plain_projection(generated, points, 4, 0.3**2))


def test_samplenet_gamma_replaces_alpha():
    without = SampleNet(6, alpha=30.0)
    with_gamma = SampleNet(6, alpha=30.0, gamma=5e-5)
    of_zero = SampleNet(6, gamma=0.0)

    assert without.alpha == 30
    assert with_gamma.alpha == 5e-5
    assert of_zero.alpha == 0


def test_samplenet_keeps_its_beta():
    assert SampleNet(6, beta=1e-4).beta == 1e-4


@pytest.mark.parametrize(
    ("sigma_min", "t", "sigma"),
    [
        (0.0, 0.001, 1e-6),
        (1e-2, 0.05, 1e-2),
        (1e-2, 0.5, 0.25),
        (1e-4, 0.001, 1e-4),
    ],
)
def test_samplenet_sigma_has_lower_bound(sigma_min, t, sigma):
    net = SampleNet(6, sigma_min=sigma_min)
    torch.nn.init.constant_(net.temperature, t)
    assert math.isclose(net.sigma.item(), sigma, rel_tol=1e-5)


def test_progressive_training_sizes_are_powers_of_two():
    by_default = ProgressiveSampleNet()
    from_16_to_100 = ProgressiveSampleNet(100, min_size=16)
    of_one_point = ProgressiveSampleNet(1)

    assert by_default.training_sizes() == (2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
    assert from_16_to_100.training_sizes() == (16, 32, 64, 100)
    assert of_one_point.training_sizes() == (1,)


def test_progressive_samples_are_nested(randn):
    net = ProgressiveSampleNet(16, coverage=0.5, coverage_per_point=1 / 30).train()
    points = randn(4, 40, 3)
    net(points)  # running statistics change with every call, the result does not
    whole = net(points).points

    outputs = net.sample_sizes(points, net.training_sizes())

    assert list(outputs) == [2, 4, 8, 16]
    for m, output in outputs.items():
        first = whole[:, :m]
        assert torch.equal(output.points, first)
        expected = 30 * simplification_loss(points, first, 0.5, 1 / 30)
        assert_close(output.losses["simplification"], expected)


@pytest.mark.parametrize("reduction", ["sum", "mean"])
def test_progressive_samplenet_adds_projection_once(reduction, randn):
    net = ProgressiveSampleNet(16, k=3, beta=0.5, size_reduction=reduction).train()
    points = randn(4, 30, 3)
    sizes = net.training_sizes()

    outputs = net.sample_sizes(points, sizes)

    assert len(sizes) == 4
    losses = [outputs[m].losses["projection"].item() for m in sizes]
    total = sum(losses)
    if reduction == "mean":
        total /= 4
    assert total == pytest.approx(0.5)  # sigma starts at 1
