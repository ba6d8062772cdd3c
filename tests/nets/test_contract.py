"""What every net of one cloud guarantees. A new net adds one line to NETS or CLASSIFIERS."""

from typing import Any

import pytest
import torch

from mops_lightning.nets.atlasnet import AtlasNet
from mops_lightning.nets.autoencoder import AutoEncoder
from mops_lightning.nets.dgcnn import DGCNN
from mops_lightning.nets.foldingnet import MFoldingNet
from mops_lightning.nets.hierarchical import HierarchicalNet
from mops_lightning.nets.pointnet import PointNetTransform, PointNetVanilla, TransformNet
from mops_lightning.samplers.fps import FPSSampler
from tests.support.mixed import check_close_in_mixed_precision

NETS = {
    "autoencoder": lambda n: AutoEncoder(n, 16, (8, 8)),
    "foldingnet": lambda n: MFoldingNet(n, 1, 16, fold_channels=(32, 8)),
    "mfoldingnet": lambda n: MFoldingNet(n, 4, 16, fold_channels=(32, 8)),
    "atlasnet": lambda n: AtlasNet(n, 3, 16, (32, 8)),
}
CLASSIFIERS = {
    "pointnet": lambda _: PointNetVanilla(5),
    "pointnet_transform": lambda _: PointNetTransform(5),
    "dgcnn": lambda _: DGCNN(5),
    "hierarchical": lambda _: HierarchicalNet(5, FPSSampler, (20, 8), (8, 16, 16), 4),
}
ALL = {**NETS, **CLASSIFIERS}


@pytest.mark.parametrize("name", ALL)
def test_output_is_independent_of_order_and_batch(name, rng):
    torch.manual_seed(0)
    net = ALL[name](50).eval()
    points = torch.randn(3, 40, 3, generator=rng)
    out = net(points)
    assert out.shape == ((3, 5) if name in CLASSIFIERS else (3, 50, 3))
    order = torch.randperm(40, generator=rng)
    torch.testing.assert_close(net(points[:, order]), out, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(net(points[1:2]), out[1:2], atol=1e-5, rtol=1e-4)
    assert net(points[:, :7]).shape == net(points[:, :1]).shape == out.shape


@pytest.mark.parametrize("name", ALL)
def test_all_parameters_have_gradients(name, rng):
    torch.manual_seed(0)
    net = ALL[name](50)
    for module in net.modules():
        if isinstance(module, TransformNet):  # its last weights are zero, which stops gradients
            torch.nn.init.normal_(list(module.head.parameters())[-2], std=0.01)
    net(torch.randn(3, 40, 3, generator=rng)).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in net.parameters())


@pytest.mark.parametrize("name", ALL)
def test_mixed_precision_is_close_with_finite_gradients(name, rng):
    torch.manual_seed(0)
    check_close_in_mixed_precision(ALL[name](50).eval(), torch.randn(8, 60, 3, generator=rng))


@pytest.mark.parametrize("name", ["foldingnet", "mfoldingnet", "atlasnet"])
@pytest.mark.parametrize("n", [4, 7, 50, 101, 300])
def test_number_of_points_is_variable(name, n, rng):
    torch.manual_seed(0)
    net = NETS[name](50).eval()
    points = torch.randn(2, 40, 3, generator=rng)
    assert net(points, n).shape == (2, n, 3)
    net.n_points = n
    torch.testing.assert_close(net(points), net(points, n))


@pytest.mark.parametrize("name", [*NETS, "pointnet"])
def test_result_follows_from_maxima_of_point_features(name, rng):
    torch.manual_seed(0)
    net: Any = ALL[name](50).eval()
    points = torch.randn(2, 40, 3, generator=rng)
    features = net.point_features(points)
    assert features.min() >= 0
    torch.testing.assert_close(net.from_pooled(features.amax(1)), net(points))
    torch.testing.assert_close(net.point_features(points[:, 7:9]), features[:, 7:9])
