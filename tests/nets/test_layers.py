import torch

from mops_lightning.nets.layers import PointFeatures


def test_point_features_global_is_maximum_of_local(rng):
    torch.manual_seed(0)
    net = PointFeatures((8, 6)).eval()
    points = torch.randn(2, 30, 3, generator=rng)
    local, global_ = net(points)
    assert local.shape == (2, 30, 6)
    torch.testing.assert_close(global_, local.max(1).values)
