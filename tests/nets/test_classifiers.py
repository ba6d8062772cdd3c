"""What is specific to classifiers; see test_contract for what all nets guarantee."""

from functools import partial
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from mops_lightning.nets.dgcnn import DGCNN
from mops_lightning.nets.hierarchical import HierarchicalNet, HierarchicalSegmentation
from mops_lightning.nets.pointnet import PointNetTransform, PointNetVanilla, TransformNet
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.fps import FPSSampler


def test_transform_net_starts_at_identity(randn):
    features = randn(3, 20, 4)

    matrix = TransformNet(4)(features)

    identity = torch.eye(4).expand(3, 4, 4)
    assert_close(matrix, identity)


CLASSIFIERS = [
    PointNetVanilla,
    PointNetTransform,
    DGCNN,
]

SMALL: dict[str, Any] = {
    "sampler": FPSSampler,
    "points": (20, 8),
    "channels": (8, 16, 16),
    "k": 4,
}
HIERARCHICAL = [partial(net, **SMALL) for net in (HierarchicalNet, HierarchicalSegmentation)]


@pytest.mark.parametrize("classifier", [*CLASSIFIERS, *HIERARCHICAL])
def test_dropout_has_its_probability_and_acts_in_training(classifier, randn):
    points = randn(4, 30, 3)
    net = classifier(5, dropout=0.25).train()
    without = classifier(5, dropout=0.0).train()

    first = net(points)
    second = net(points)

    (layer,) = [module for module in net.modules() if isinstance(module, torch.nn.Dropout)]
    assert layer.p == 0.25
    assert not torch.allclose(first, second, atol=1e-3)
    assert_close(without(points), without(points))


def set_bias(transform, matrix):
    """Make a transform net return one matrix."""
    transform.head[-1].bias.copy_(matrix.flatten())


@torch.no_grad()
def test_pointnet_transforms_multiply_rows_of_points_and_of_features(randn):
    """The first transform moves the points, the second one can be part of the next layer."""
    net: Any = PointNetTransform(5).eval()
    points = randn(2, 30, 3)
    of_points = randn(3, 3)
    noise = randn(64, 64)
    of_features = torch.eye(64) + 0.3 * noise
    next_layer = net.features.layers[0].weight
    set_bias(net.point_transform, of_points)
    set_bias(net.feature_transform, of_features)

    logits = net(points)

    set_bias(net.point_transform, torch.eye(3))
    set_bias(net.feature_transform, torch.eye(64))
    next_layer.copy_(next_layer @ of_features.mT)
    expected = net(points @ of_points)
    assert_close(logits, expected, atol=1e-5, rtol=1e-4)


def plain_edge_convolution(layer, features):
    """Return the maxima over the edges to the 4 nearest neighbours among the features."""
    near = torch.cdist(features, features).topk(4, largest=False).indices
    differences = gather_points(features, near) - features[:, :, None]
    own = layer.own(features)
    edges = own[:, :, None] + layer.edge(differences)
    normed = layer.norm(edges.amax(2).flatten(0, 1))
    return normed.relu().unflatten(0, features.shape[:2])


def test_dgcnn_neighbours_are_found_in_the_space_of_features(randn):
    """Every edge convolution has a graph of its own."""
    net: Any = DGCNN(5, k=4, edge_channels=(8, 8)).eval()
    points = randn(2, 30, 3)

    logits = net(points)

    features = points
    outputs = []
    for layer in net.edges:
        features = plain_edge_convolution(layer, features)
        outputs.append(features)
    pooled = net.pool(torch.cat(outputs, 2))
    assert_close(logits, net.head(pooled), atol=1e-5, rtol=1e-4)
