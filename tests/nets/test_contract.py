"""What every net of one cloud guarantees. A new net adds one line to NETS or CLASSIFIERS."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from mops_lightning.errors import UserError
from mops_lightning.nets.atlasnet import AtlasNet
from mops_lightning.nets.autoencoder import AutoEncoder, PointEncoder
from mops_lightning.nets.dgcnn import DGCNN
from mops_lightning.nets.foldingnet import MFoldingNet
from mops_lightning.nets.hierarchical import HierarchicalNet
from mops_lightning.nets.layers import PointFeatures, PointMLP
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.nets.pointnet import PointNetTransform, PointNetVanilla, TransformNet
from mops_lightning.samplers.fps import FPSSampler
from tests.support.mixed import mixed


def small_hierarchical_net() -> HierarchicalNet:
    return HierarchicalNet(5, FPSSampler, points=(20, 8), channels=(8, 16, 16), k=4)


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
    "hierarchical": lambda _: small_hierarchical_net(),
}
ALL = {**NETS, **CLASSIFIERS}


@pytest.mark.parametrize("name", ALL)
def test_output_is_independent_of_order_and_batch(name, rng, randn):
    net = ALL[name](50).eval()
    points = randn(3, 40, 3)
    order = torch.randperm(40, generator=rng)
    shape = (3, 5) if name in CLASSIFIERS else (3, 50, 3)

    out = net(points)
    out_in_order = net(points[:, order])
    out_alone = net(points[1:2])

    assert out.shape == shape
    assert_close(out_in_order, out, atol=1e-5, rtol=1e-4)
    assert_close(out_alone, out[1:2], atol=1e-5, rtol=1e-4)
    assert net(points[:, :7]).shape == shape
    assert net(points[:, :1]).shape == shape


@pytest.mark.parametrize("name", ALL)
def test_all_parameters_have_gradients(name, randn):
    net = ALL[name](50)
    for module in net.modules():
        if isinstance(module, TransformNet):  # its last weights are zero, which stops gradients
            *_, last_weight, _ = module.head.parameters()
            torch.nn.init.normal_(last_weight, std=0.01)
    points = randn(3, 40, 3)

    net(points).square().sum().backward()

    for parameter_name, weights in net.named_parameters():
        assert weights.grad is not None, parameter_name
        assert weights.grad.abs().sum() > 0, parameter_name


@pytest.mark.parametrize("name", ALL)
def test_mixed_precision_is_close_with_finite_gradients(name, randn):
    net = ALL[name](50).eval()
    points = randn(8, 60, 3)

    single = net(points)
    half = mixed(net, points)
    half.square().sum().backward()

    assert half.dtype == torch.float32
    assert_close(half, single, rtol=0.05, atol=0.05)
    for weights in net.parameters():
        assert weights.grad is not None
        assert weights.grad.isfinite().all()


@pytest.mark.parametrize("name", ["foldingnet", "mfoldingnet", "atlasnet"])
@pytest.mark.parametrize("n", [4, 7, 50, 101, 300])
def test_number_of_points_is_variable(name, n, randn):
    net = NETS[name](50).eval()
    points = randn(2, 40, 3)

    asked = net(points, n)
    net.n_points = n
    by_default = net(points)

    assert asked.shape == (2, n, 3)
    assert_close(by_default, asked)


@pytest.mark.parametrize("name", NETS)
def test_result_follows_from_maxima_of_point_features(name, randn):
    net: Any = ALL[name](50).eval()
    points = randn(2, 40, 3)

    features = net.point_features(points)
    features_of_two = net.point_features(points[:, 7:9])

    assert features.min() >= 0
    maxima = features.amax(1)
    assert_close(net.from_pooled(maxima), net(points))
    assert_close(features_of_two, features[:, 7:9])


@pytest.mark.parametrize(
    ("net", "channels"),
    [
        (PointNetVanilla(40), [3, 64, 64, 64, 128, 1024, 512, 256, 40]),
        (PointEncoder(), [3, 64, 128, 128, 256, 128]),
    ],
)
def test_net_has_published_layers(net, channels):
    found = []
    for module in net.modules():
        if isinstance(module, torch.nn.Linear):
            found.append((module.in_features, module.out_features))
    assert found == list(pairwise(channels))


def test_autoencoder_has_published_size():
    sizes = [weights.numel() for weights in AutoEncoder().parameters()]
    megabytes = 4e-6 * sum(sizes)
    assert megabytes == pytest.approx(4.1, abs=0.2)


def test_point_features_global_is_maximum_of_local(randn):
    features = PointFeatures(PointMLP([3, 8, 6])).eval()

    local, global_ = features(randn(2, 30, 3))

    assert local.shape == (2, 30, 6)
    assert_close(global_, local.max(1).values)


POINTS = torch.ones(2, 40, 3)
INVALID: list[tuple[Callable[[], Any], str]] = [
    (lambda: AtlasNet(pieces=0), r"^pieces must be at least 1, got 0"),
    (lambda: AtlasNet(3, pieces=4), r"^n_points must be at least pieces=4, got 3"),
    (lambda: AtlasNet(patch_channels=[0]), r"^patch_channels must be .*got \[0\]"),
    (lambda: AutoEncoder(0), r"^n_points must be at least 1, got 0"),
    (lambda: AutoEncoder(codeword=0), r"^codeword must be at least 1, got 0"),
    (lambda: AutoEncoder(encoder_channels=[]), r"^encoder_channels must be .*got \[\]"),
    (lambda: AutoEncoder(50)(POINTS, 60), "^n_points must be 50, .* got 60.*mfoldingnet"),
    (lambda: PointEncoder(0), r"^codeword must be at least 1, got 0"),
    (lambda: PointEncoder(channels=[0]), r"^channels must be .*got \[0\]"),
    (lambda: MFoldingNet(pieces=3), r"^pieces must be a divisor of codeword=128, got 3"),
    (lambda: MFoldingNet(n_points=2), r"^n_points must be at least pieces=4, got 2"),
    (lambda: MFoldingNet(fold_channels=[]), r"^fold_channels must be .*got \[\]"),
    (lambda: MFoldingNet()(POINTS, 3), r"^n_points must .* pieces=4, got 3"),
    (lambda: MFoldingNet(codeword=0), "^codeword must be at least 1, got 0"),
    (lambda: PCRNet(0), r"^iterations must be at least 1, got 0"),
    (lambda: PCRNet(feature_channels=[8]), r"^feature_channels must be .* got \[8\]"),
    (lambda: DGCNN(5, k=0), "k must be at least 1, got 0"),
    (lambda: DGCNN(5, edge_channels=()), "edge_channels must be"),
    (lambda: HierarchicalNet(5, FPSSampler, (20, 8), (8, 16)), "one number more than the 2 of po"),
    (lambda: HierarchicalNet(5, FPSSampler, [8, 9], [8] * 3), r"points must not .*got \[8, 9\]"),
    (lambda: HierarchicalNet(5, FPSSampler, k=0), "k must be at least 1, got 0"),
    (lambda: HierarchicalNet(5, FPSSampler, hidden=0), "hidden must be at least 1, got 0"),
]


@pytest.mark.parametrize(("make", "message"), INVALID)
def test_invalid_argument_raises(make, message):
    with pytest.raises(UserError, match=message):
        make()


def test_atlasnet_is_random_in_training_only(randn):
    net = AtlasNet(50, 3, 16, (32, 8))
    points = randn(2, 40, 3)

    trained = net(points)
    trained_again = net(points)
    net.eval()
    tested = net(points)
    tested_again = net(points)

    assert not torch.equal(trained, trained_again)
    assert torch.equal(tested, tested_again)


def test_atlasnet_has_a_decoder_of_its_own_for_each_piece():
    net = AtlasNet(50, 3, 16, (32, 8))

    parameters = list(net.patches.parameters())

    different = {id(parameter) for parameter in parameters}
    assert len(different) == 3 * 10
