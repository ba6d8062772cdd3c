"""EdgeConv features against a plain twin, and samplers with them."""

import pytest
import torch
from torch import Tensor, nn

from mops_lightning import FMOPSNet, MOPSNet, SampleNet, SNet
from mops_lightning.errors import UserError
from mops_lightning.samplers.edges import EdgeMLP
from mops_lightning.zoo.export import GeneratedPoints


def plain_edge_mlp(net: EdgeMLP, points: Tensor) -> Tensor:
    """All edges (x_i, x_j − x_i) as one tensor, one cloud at a time."""
    n = points.shape[1]
    count = min(n, net.references)
    chosen = [i * n // count for i in range(count)]
    k = min(net.k, count)
    nearest = torch.cdist(points.double(), points[:, chosen].double()).topk(k, largest=False)[1]
    features, layers = points, list(net.layers)
    for edge in net.edges:
        linear, norm, relu = layers[:3]
        x_j = torch.stack([x[chosen][rows] for x, rows in zip(features, nearest, strict=True)])
        x_i = features[:, :, None].expand_as(x_j)
        rows = (linear(x_i) + edge(x_j - x_i)).amax(2)
        features = relu(norm(rows.flatten(0, 1))).unflatten(0, rows.shape[:2])
        layers = layers[3:]
    return nn.Sequential(*layers)(features.flatten(0, 1)).unflatten(0, features.shape[:2])


@pytest.mark.parametrize(("n", "k", "references"), [(40, 5, 16), (12, 16, 256)])
def test_edge_layers_equal_the_plain_twin(n: int, k: int, references: int) -> None:
    torch.manual_seed(0)
    net = EdgeMLP([3, 8, 8, 6, 10, 4], k=k, references=references)
    points = torch.randn(3, n, 3)
    grads = []
    for forward in (net, lambda x: plain_edge_mlp(net, x)):
        x = points.clone().requires_grad_()
        result = forward(x)
        weights = torch.linspace(-1, 1, result.numel()).view_as(result)
        total = (result * weights).sum()
        grads.append([result, *torch.autograd.grad(total, [x, *net.parameters()])])
    for ours, twin in zip(*grads, strict=True):
        torch.testing.assert_close(ours, twin, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("net", [MOPSNet, FMOPSNet, SNet, SampleNet])
def test_samplers_train_with_edge_features(net: type) -> None:
    torch.manual_seed(0)
    sampler = net(8, features="edgeconv")
    points = torch.rand(4, 300, 3)
    output = sampler.sample(points, 8)
    next(iter(sampler.losses(points, output, (8,))[8].values())).backward()
    edges = next(m for m in sampler.modules() if isinstance(m, EdgeMLP)).edges
    assert all(weight.grad is not None and weight.grad.any() for weight in edges.parameters())
    sampler.eval()
    torch.testing.assert_close(sampler(points).points, sampler.sample(points, 8).points)
    with pytest.raises(UserError, match="features=edgeconv cannot be exported"):
        GeneratedPoints(sampler)
    with pytest.raises(UserError, match="cannot sample in chunks"):
        sampler.fused()
    with pytest.raises(UserError, match=r"features: unknown .edgeconf."):
        net(8, features="edgeconf")
