import math

import pytest
import torch

from mops_lightning.ops.nearest import k_nearest, nearest
from mops_lightning.samplers.samplenet import ProgressiveSampleNet, SampleNet, soft_projection
from tests.support.losses import simplification_loss


def plain_projection(queries, points, k, sigma):
    """Project every point in a double loop, differentiably."""
    projected = []
    for query_cloud, cloud in zip(queries, points, strict=True):
        rows = []
        for q in query_cloud:
            near = sorted(cloud, key=lambda p: float((q - p).detach().square().sum()))[:k]
            weights = [torch.exp(-(q - p).square().sum() / sigma) for p in near]
            rows.append(sum(w * p for w, p in zip(weights, near, strict=True)) / sum(weights))
        projected.append(torch.stack(rows))
    return torch.stack(projected)


@pytest.mark.parametrize("k", [1, 4, 11])
def test_soft_projection_equals_double_loop(k, rng):
    points = torch.randn(2, 11, 3, generator=rng, dtype=torch.float64)
    queries = torch.randn(2, 5, 3, generator=rng, dtype=torch.float64)
    inputs = [queries, points, torch.tensor(0.7, dtype=torch.float64)]
    inputs = [x.requires_grad_() for x in inputs]
    weights = torch.randn(2, 5, 3, generator=rng, dtype=torch.float64)
    fast = soft_projection(inputs[0], inputs[1], k, inputs[2])
    plain = plain_projection(inputs[0], inputs[1], k, inputs[2])
    torch.testing.assert_close(fast, plain)
    if k == 1:
        return  # the weight is 1 for any query and sigma
    got = torch.autograd.grad((fast * weights).sum(), inputs)
    want = torch.autograd.grad((plain * weights).sum(), inputs)
    for one, other in zip(got, want, strict=True):
        torch.testing.assert_close(one, other)


def test_soft_projection_limits_are_nearest_point_and_mean(rng):
    points = torch.randn(3, 50, 3, generator=rng)
    queries = torch.randn(3, 9, 3, generator=rng)
    index = nearest(queries, points)[1]
    closest = points.gather(1, index[..., None].expand(-1, -1, 3))
    torch.testing.assert_close(soft_projection(queries, points, 7, 1e-9), closest)
    assert torch.isfinite(soft_projection(queries, points, 7, torch.tensor(1e-38))).all()
    rows = k_nearest(queries, points, 7)[1].flatten(1)
    neighbours = points.gather(1, rows[..., None].expand(-1, -1, 3)).unflatten(1, (9, 7))
    torch.testing.assert_close(soft_projection(queries, points, 7, 1e9), neighbours.mean(2))


def test_samplenet_projects_in_training_only(rng):
    net = SampleNet(6, k=4, beta=0.5, alpha=3.0).train()
    points = torch.randn(4, 20, 3, generator=rng)
    assert net(points).losses["projection"] == 0.5  # sigma starts at 1²
    torch.nn.init.constant_(net.temperature, 0.6)
    output = net(points)
    projected = soft_projection(output.points, points, 4, 0.6**2)
    torch.testing.assert_close(output.soft_projected, projected)
    torch.testing.assert_close(output.losses["projection"], torch.tensor(0.5 * 0.6**2))
    expected = 3 * simplification_loss(points, output.points)
    torch.testing.assert_close(output.losses["simplification"], expected)
    assert net.eval()(points).soft_projected is None


def test_samplenet_projection_in_evaluation_equals_double_loop_with_learned_temperature(rng):
    net = SampleNet(6, k=4)
    torch.nn.init.constant_(net.temperature, 0.3)
    points = torch.randn(2, 20, 3, generator=rng)
    points[:, 10:] = points[:, :10]  # duplicates tie
    generated = net.eval()(points).points

    projected = net.project(generated, points)

    torch.testing.assert_close(projected, plain_projection(generated, points, 4, 0.3**2))


def test_samplenet_gamma_replaces_alpha():
    assert SampleNet(6, alpha=30.0).alpha == 30
    assert SampleNet(6, alpha=30.0, gamma=5e-5).alpha == 5e-5
    assert SampleNet(6, gamma=0.0).alpha == 0
    assert SampleNet(6, beta=1e-4).beta == 1e-4


@pytest.mark.parametrize(
    ("sigma_min", "t", "sigma"),
    [(0.0, 0.001, 1e-6), (1e-2, 0.05, 1e-2), (1e-2, 0.5, 0.25), (1e-4, 0.001, 1e-4)],
)
def test_samplenet_sigma_has_lower_bound(sigma_min, t, sigma):
    net = SampleNet(6, sigma_min=sigma_min)
    torch.nn.init.constant_(net.temperature, t)
    assert math.isclose(net.sigma.item(), sigma, rel_tol=1e-5)


def test_progressive_training_sizes_are_powers_of_two():
    sizes = (2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
    assert ProgressiveSampleNet().training_sizes() == sizes
    assert ProgressiveSampleNet(100, min_size=16).training_sizes() == (16, 32, 64, 100)
    assert ProgressiveSampleNet(1).training_sizes() == (1,)


def test_progressive_samples_are_nested(rng):
    net = ProgressiveSampleNet(16, coverage=0.5, coverage_per_point=1 / 30).train()
    points = torch.randn(4, 40, 3, generator=rng)
    net(points)  # running statistics change with every call, the result does not
    whole = net(points).points
    outputs = net.sample_sizes(points, net.training_sizes())
    assert list(outputs) == [2, 4, 8, 16]
    for m, output in outputs.items():
        assert torch.equal(output.points, whole[:, :m])
        expected = 30 * simplification_loss(points, whole[:, :m], 0.5, 1 / 30)
        torch.testing.assert_close(output.losses["simplification"], expected)


@pytest.mark.parametrize("reduction", ["sum", "mean"])
def test_progressive_samplenet_adds_projection_once(reduction, rng):
    net = ProgressiveSampleNet(16, k=3, beta=0.5, size_reduction=reduction).train()
    sizes = net.training_sizes()
    outputs = net.sample_sizes(torch.randn(4, 30, 3, generator=rng), sizes)
    terms = torch.stack([outputs[m].losses["projection"] for m in sizes])
    total = terms.sum() if reduction == "sum" else terms.mean()
    assert len(sizes) == 4
    torch.testing.assert_close(total, torch.tensor(0.5))  # sigma starts at 1
