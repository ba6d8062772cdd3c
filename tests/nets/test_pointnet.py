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
