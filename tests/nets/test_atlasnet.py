import torch

from mops_lightning.nets.atlasnet import AtlasNet


def test_atlasnet_is_random_in_training_only(rng):
    net = AtlasNet(50, 3, 16, (32, 8))
    points = torch.randn(2, 40, 3, generator=rng)
    assert not torch.equal(net(points), net(points))
    net.eval()
    assert torch.equal(net(points), net(points))
    assert len({id(parameter) for parameter in net.patches.parameters()}) == 3 * 10
