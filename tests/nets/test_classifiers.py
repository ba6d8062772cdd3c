"""What every classifier guarantees. A new net adds one line to NETS."""

from typing import Any

import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.nets.dgcnn import DGCNN, max_of_rows
from mops_lightning.nets.pointnet import PointNetTransform, PointNetVanilla, TransformNet
from tests.support.mixed import check_close_in_mixed_precision

NETS = {"pointnet": PointNetVanilla, "pointnet_transform": PointNetTransform, "dgcnn": DGCNN}


@pytest.mark.parametrize("name", NETS)
def test_logits_are_independent_of_order_and_batch(name, rng):
    torch.manual_seed(0)
    net = NETS[name](5).eval()
    points = torch.randn(3, 60, 3, generator=rng)
    logits = net(points)
    assert logits.shape == (3, 5)
    order = torch.randperm(60, generator=rng)
    torch.testing.assert_close(net(points[:, order]), logits, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(net(points[1:2]), logits[1:2], atol=1e-5, rtol=1e-4)
    assert net(points[:, :1]).shape == (3, 5)


@pytest.mark.parametrize("name", NETS)
def test_all_parameters_have_gradients(name, rng):
    torch.manual_seed(0)
    net = NETS[name](5)
    for module in net.modules():
        if isinstance(module, TransformNet):  # its last weights are zero, which stops gradients
            torch.nn.init.normal_(list(module.head.parameters())[-2], std=0.01)
    net(torch.randn(4, 60, 3, generator=rng)).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in net.parameters())


@pytest.mark.parametrize("name", NETS)
def test_mixed_precision_is_close_with_finite_gradients(name, rng):
    torch.manual_seed(0)
    check_close_in_mixed_precision(NETS[name](5).eval(), torch.randn(8, 60, 3, generator=rng))


def test_transform_net_starts_at_identity(rng):
    matrix = TransformNet(4)(torch.randn(3, 20, 4, generator=rng))
    torch.testing.assert_close(matrix, torch.eye(4).expand(3, 4, 4))


def test_dgcnn_neighbours_are_found_in_the_space_of_features(rng):
    """Every edge convolution has a graph of its own."""
    torch.manual_seed(0)
    net: Any = DGCNN(5, k=4, edge_channels=(8, 8)).eval()
    points = torch.randn(2, 30, 3, generator=rng)
    features, outputs = points, []
    for layer in net.edges:
        near = torch.cdist(features, features).topk(4, largest=False).indices
        others = features[torch.arange(2)[:, None, None], near]
        edges = layer.own(features)[:, :, None] + layer.edge(others - features[:, :, None])
        features = layer.norm(edges.amax(2).flatten(0, 1)).relu().unflatten(0, (2, 30))
        outputs.append(features)
    expected = net.head(net.pool(torch.cat(outputs, 2)))
    torch.testing.assert_close(net(points), expected, atol=1e-5, rtol=1e-4)


def test_max_of_rows_equals_maximum_of_gathered_rows(rng):
    features = torch.randn(2, 20, 6, generator=rng, requires_grad=True)
    rows = torch.randint(20, (2, 9, 4), generator=rng)
    gathered = features[torch.arange(2)[:, None, None], rows].amax(2)
    found = max_of_rows(features, rows)
    torch.testing.assert_close(found, gathered)
    weight = torch.randn(found.shape, generator=rng)
    expected = torch.autograd.grad((gathered * weight).sum(), features)
    torch.testing.assert_close(torch.autograd.grad((found * weight).sum(), features), expected)


def test_dgcnn_bad_arguments_raise():
    with pytest.raises(UserError, match="k must be at least 1, got 0"):
        DGCNN(5, k=0)
    with pytest.raises(UserError, match="edge_channels must be"):
        DGCNN(5, edge_channels=())
