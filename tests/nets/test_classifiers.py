"""What is specific to classifiers; see test_contract for what all nets guarantee."""

from typing import Any

import torch

from mops_lightning.nets.dgcnn import DGCNN
from mops_lightning.nets.pointnet import PointNetTransform, TransformNet
from mops_lightning.ops import compiled
from mops_lightning.ops.maxima import max_of_rows


def test_transform_net_starts_at_identity(rng):
    matrix = TransformNet(4)(torch.randn(3, 20, 4, generator=rng))
    torch.testing.assert_close(matrix, torch.eye(4).expand(3, 4, 4))


def test_pointnet_transforms_multiply_rows_of_points_and_of_features(rng):
    """The first transform moves the points, the second one can be part of the next layer."""
    net: Any = PointNetTransform(5).eval()
    points = torch.randn(2, 30, 3, generator=rng)
    of_points = torch.randn(3, 3, generator=rng)
    of_features = torch.eye(64) + 0.3 * torch.randn(64, 64, generator=rng)
    next_layer = net.features.layers[0].weight

    with torch.no_grad():
        net.point_transform.head[-1].bias.copy_(of_points.flatten())
        net.feature_transform.head[-1].bias.copy_(of_features.flatten())
        found = net(points)
        net.point_transform.head[-1].bias.copy_(torch.eye(3).flatten())
        net.feature_transform.head[-1].bias.copy_(torch.eye(64).flatten())
        next_layer.copy_(next_layer @ of_features.mT)
        expected = net(points @ of_points)

    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)


def test_dgcnn_neighbours_are_found_in_the_space_of_features(rng):
    """Every edge convolution has a graph of its own."""
    net: Any = DGCNN(5, k=4, edge_channels=(8, 8)).eval()
    points = torch.randn(2, 30, 3, generator=rng)
    features = points
    outputs = []
    for layer in net.edges:
        near = torch.cdist(features, features).topk(4, largest=False).indices
        others = features[torch.arange(2)[:, None, None], near]
        edges = layer.own(features)[:, :, None] + layer.edge(others - features[:, :, None])
        features = layer.norm(edges.amax(2).flatten(0, 1)).relu().unflatten(0, (2, 30))
        outputs.append(features)
    expected = net.head(net.pool(torch.cat(outputs, 2)))
    torch.testing.assert_close(net(points), expected, atol=1e-5, rtol=1e-4)


def test_max_of_rows_equals_maximum_of_gathered_rows(rng, monkeypatch):
    monkeypatch.setattr(compiled, "THREADS_MIN_WORK", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    features = torch.randn(2, 20, 6, generator=rng, requires_grad=True)
    rows = torch.randint(20, (2, 9, 4), generator=rng)
    gathered = features[torch.arange(2)[:, None, None], rows].amax(2)
    found = max_of_rows(features, rows)
    torch.testing.assert_close(found, gathered)
    weight = torch.randn(found.shape, generator=rng)
    expected = torch.autograd.grad((gathered * weight).sum(), features)
    torch.testing.assert_close(torch.autograd.grad((found * weight).sum(), features), expected)
