from itertools import pairwise

import torch

from mops_lightning.nets.pointnet import PointNetVanilla


def test_pointnet_has_published_layers():
    sizes = [
        tuple(module.weight.shape)
        for module in PointNetVanilla(40).modules()
        if isinstance(module, torch.nn.Linear)
    ]
    channels = [3, 64, 64, 64, 128, 1024, 512, 256, 40]
    assert sizes == [(b, a) for a, b in pairwise(channels)]


def test_pointnet_follows_from_maxima_of_point_features(rng):
    torch.manual_seed(0)
    net = PointNetVanilla(5).eval()
    points = torch.randn(3, 200, 3, generator=rng)
    features = net.point_features(points)
    torch.testing.assert_close(net.from_pooled(features.amax(1)), net(points))
    torch.testing.assert_close(net.point_features(points[:, 7:9]), features[:, 7:9])
