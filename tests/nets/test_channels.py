"""Nets of points with channels beside x, y and z."""

from typing import Any

import pytest
import torch
from torch.testing import assert_close

from mops_lightning.channels import Channel, PointChannels
from mops_lightning.nets.atlasnet import AtlasNet
from mops_lightning.nets.autoencoder import AutoEncoder
from mops_lightning.nets.dgcnn import DGCNN
from mops_lightning.nets.foldingnet import MFoldingNet
from mops_lightning.nets.hierarchical import HierarchicalNet, HierarchicalSegmentation
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.nets.pointnet import PointNetTransform, PointNetVanilla
from mops_lightning.ops.rigid import Motion, move, random_motion
from mops_lightning.samplers.fps import FPSSampler


def hierarchical(net: Any, channels: int) -> Any:
    sizes = (20, 8)
    widths = (8, 16, 16)
    return net(5, FPSSampler, sizes, widths, k=4, point_channels=channels)


NETS = {
    "pointnet": lambda c: PointNetVanilla(5, point_channels=c),
    "pointnet_transform": lambda c: PointNetTransform(5, point_channels=c),
    "dgcnn": lambda c: DGCNN(5, k=4, point_channels=c),
    "hierarchical": lambda c: hierarchical(HierarchicalNet, c),
    "segmentation": lambda c: hierarchical(HierarchicalSegmentation, c),
    "autoencoder": lambda c: AutoEncoder(50, 16, (8, 8), point_channels=c),
    "mfoldingnet": lambda c: MFoldingNet(50, 4, 16, fold_channels=(32, 8), point_channels=c),
    "atlasnet": lambda c: AtlasNet(50, 3, 16, (32, 8), point_channels=c),
}
WITH_NORMALS = PointChannels(
    (
        Channel("intensity"),
        Channel("normal_x"),
        Channel("normal_y"),
        Channel("normal_z"),
    )
)


@pytest.mark.parametrize("name", NETS)
def test_net_reads_every_channel_independent_of_order_and_batch(name, rng, randn):
    net = NETS[name](2).eval()
    points = randn(3, 40, 5, requires_grad=True)
    order = torch.randperm(40, generator=rng)

    out = net(points)
    out_in_order = net(points[:, order])
    out_alone = net(points[1:2])

    (gradient,) = torch.autograd.grad(out.square().sum(), points)
    by_channel = gradient.abs().sum((0, 1))
    expected_in_order = out
    if name == "segmentation":
        expected_in_order = out[:, order]
    assert (by_channel > 0).all()
    assert_close(out_alone, out[1:2], atol=1e-5, rtol=1e-4)
    assert_close(out_in_order, expected_in_order, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", NETS)
def test_weights_have_the_names_of_a_net_without_channels(name):
    default = NETS[name](0).state_dict()
    wider = NETS[name](2).state_dict()

    assert list(default) == list(wider)
    number_different = 0
    for key, weights in default.items():
        if weights.shape != wider[key].shape:
            number_different += 1
            assert wider[key].shape[1] == weights.shape[1] + 2
    assert number_different > 0


def test_dgcnn_finds_the_first_neighbours_by_coordinates(randn):
    net = DGCNN(5, k=4, point_channels=1).eval()
    first: Any = net.edges[0]
    torch.nn.init.zeros_(first.own.weight[:, 3:])
    torch.nn.init.zeros_(first.edge.weight[:, 3:])
    points = randn(2, 30, 4)
    changed = points.clone()
    changed[..., 3] *= 100

    out = net(points)
    out_of_changed = net(changed)

    assert_close(out_of_changed, out)


def test_pcrnet_turns_normals_with_the_source(randn):
    torch.manual_seed(0)
    net = PCRNet(iterations=2, feature_channels=(8, 16), point_channels=WITH_NORMALS).eval()
    net.motion.bias.data = torch.tensor([1.0, 0.5, 0, 0, 0.1, 0, 0])
    source = randn(2, 30, 7)
    target = randn(2, 30, 7)

    found = net(source, target)

    net.iterations = 1
    first = net(source, target)
    moved = move(source, first, WITH_NORMALS)
    both = net(moved, target).after(first)
    assert_close(found.translation, both.translation)
    assert_close(found.quaternion, both.quaternion)


def test_move_turns_normals_and_leaves_other_channels():
    half = 0.5**0.5
    quarter_turn = torch.tensor([[half, 0, 0, half]])
    shift = torch.tensor([[5.0, 0, 0]])
    points = torch.tensor([[[1.0, 0, 0, 7.0, 1.0, 0, 0]]])

    moved = move(points, Motion(quarter_turn, shift), WITH_NORMALS)

    expected = torch.tensor([[[5.0, 1.0, 0, 7.0, 0, 1.0, 0]]])
    assert_close(moved, expected)


def test_move_without_channels_is_the_motion(rng, randn):
    motion = random_motion(45, 1.0, [rng, rng])
    points = randn(2, 9, 3)

    moved = move(points, motion, PointChannels())

    assert torch.equal(moved, motion.apply(points))
