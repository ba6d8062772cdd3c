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

NETS = {
    "pointnet": lambda c: PointNetVanilla(5, point_channels=c),
    "pointnet_transform": lambda c: PointNetTransform(5, point_channels=c),
    "dgcnn": lambda c: DGCNN(5, k=4, point_channels=c),
    "hierarchical": lambda c: HierarchicalNet(
        5, FPSSampler, (20, 8), (8, 16, 16), 4, point_channels=c
    ),
    "segmentation": lambda c: HierarchicalSegmentation(
        5, FPSSampler, (20, 8), (8, 16, 16), 4, point_channels=c
    ),
    "autoencoder": lambda c: AutoEncoder(50, 16, (8, 8), point_channels=c),
    "mfoldingnet": lambda c: MFoldingNet(50, 4, 16, fold_channels=(32, 8), point_channels=c),
    "atlasnet": lambda c: AtlasNet(50, 3, 16, (32, 8), point_channels=c),
}
WITH_NORMALS = PointChannels(
    (Channel("intensity"), Channel("normal_x"), Channel("normal_y"), Channel("normal_z"))
)


@pytest.mark.parametrize("name", NETS)
def test_net_reads_every_channel_independent_of_order_and_batch(name, rng, randn):
    net = NETS[name](2).eval()
    points = randn(3, 40, 5, requires_grad=True)
    order = torch.randperm(40, generator=rng)

    out = net(points)
    in_order = net(points[:, order])
    alone = net(points[1:2])

    (gradient,) = torch.autograd.grad(out.square().sum(), points)
    by_channel = gradient.abs().sum((0, 1))
    assert (by_channel > 0).all()
    assert_close(alone, out[1:2], atol=1e-5, rtol=1e-4)
    expected = out[:, order] if name == "segmentation" else out
    assert_close(in_order, expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", NETS)
def test_weights_have_the_names_of_a_net_without_channels(name):
    default = NETS[name](0).state_dict()
    wider = NETS[name](2).state_dict()

    assert list(default) == list(wider)
    different = [key for key in default if default[key].shape != wider[key].shape]
    assert different
    for key in different:
        assert wider[key].shape[1] == default[key].shape[1] + 2


def test_dgcnn_finds_the_first_neighbours_by_coordinates(randn):
    net = DGCNN(5, k=4, point_channels=1).eval()
    first: Any = net.edges[0]
    torch.nn.init.zeros_(first.own.weight[:, 3:])
    torch.nn.init.zeros_(first.edge.weight[:, 3:])
    points = randn(2, 30, 4)
    changed = points.clone()
    changed[..., 3] *= 100

    assert_close(net(changed), net(points))


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
    quarter_turn = torch.tensor([[0.5**0.5, 0, 0, 0.5**0.5]])
    shift = torch.tensor([[5.0, 0, 0]])
    points = torch.tensor([[[1.0, 0, 0, 7.0, 1.0, 0, 0]]])

    moved = move(points, Motion(quarter_turn, shift), WITH_NORMALS)

    expected = torch.tensor([[[5.0, 1.0, 0, 7.0, 0, 1.0, 0]]])
    assert_close(moved, expected)


def test_move_without_channels_is_the_motion(rng, randn):
    motion = random_motion(45, 1.0, [rng, rng])
    points = randn(2, 9, 3)

    assert torch.equal(move(points, motion, PointChannels()), motion.apply(points))
