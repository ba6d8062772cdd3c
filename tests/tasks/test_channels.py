"""Tasks on points with channels beside x, y and z."""

import pytest
import torch
from torch.nn import functional as F
from torch.testing import assert_close

from mops_lightning.channels import Channel, PointChannels
from mops_lightning.nets.autoencoder import AutoEncoder
from mops_lightning.nets.hierarchical import HierarchicalSegmentation
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.ops.rigid import quaternion_to_matrix
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.tasks.reconstruction import Reconstruction
from mops_lightning.tasks.registration import Registration
from mops_lightning.tasks.segmentation import Segmentation
from mops_lightning.types import Batch

WITH_NORMALS = PointChannels(
    (
        Channel("intensity"),
        Channel("normal_x"),
        Channel("normal_y"),
        Channel("normal_z"),
    )
)


@pytest.fixture
def clouds_with_normals(randn):
    clouds = randn(2, 30, 7)
    clouds[..., 4:] = F.normalize(clouds[..., 4:], dim=2)
    return clouds


def registration():
    net = PCRNet(feature_channels=(8, 16), point_channels=WITH_NORMALS)
    return Registration(net, point_channels=WITH_NORMALS)


def generators():
    return [torch.Generator().manual_seed(0), torch.Generator().manual_seed(1)]


def test_pairs_have_the_coordinates_of_pairs_without_channels(clouds_with_normals):
    without = Registration(PCRNet(feature_channels=(8, 16)))
    coordinates = clouds_with_normals[..., :3].contiguous()

    batch = registration().make_batch(clouds_with_normals, generators())

    expected = without.make_batch(coordinates, generators())
    assert_close(batch.points[..., :3], expected.points)
    assert_close(batch.centroids, expected.centroids)


def test_pairs_turn_normals_with_the_target(clouds_with_normals):
    batch = registration().make_batch(clouds_with_normals, generators())

    source, target = batch.points.chunk(2)
    rotation = quaternion_to_matrix(batch.quaternion)
    turned_normals = clouds_with_normals[..., 4:] @ rotation.mT
    assert torch.equal(source[..., 3:], clouds_with_normals[..., 3:])
    assert torch.equal(target[..., 3], clouds_with_normals[..., 3])
    assert_close(target[..., 4:], turned_normals)


def test_registration_with_channels_has_finite_losses(clouds_with_normals):
    task = registration()
    batch = task.make_batch(clouds_with_normals, generators())

    losses = task.step(batch, batch.points[:, :9]).losses

    assert losses
    for loss in losses.values():
        assert loss.isfinite()


def test_reconstruction_compares_coordinates(randn):
    points = randn(2, 40, 5)
    other_channels = points.clone()
    other_channels[..., 3:] *= -1
    net = AutoEncoder(40, 16, (8, 8), point_channels=2)
    task = Reconstruction(net, exact_up_to=None).eval()
    batch = Batch(points, torch.zeros(2, dtype=torch.int64))
    batch_of_others = batch._replace(points=other_channels)
    sample = points[:, :9]

    step = task.step(batch, sample)
    step_of_others = task.step(batch_of_others, sample)
    scores = task.scores(batch, {"first": sample})

    assert step.output.shape == (2, 40, 3)
    assert_close(step.losses, step_of_others.losses)
    assert_close(scores["first"].losses["chamfer"], step.losses["chamfer"])


def test_segmentation_interpolates_by_coordinates(randn):
    points = randn(2, 40, 4)
    scaled = points.clone()
    scaled[..., 3] *= 100
    net = HierarchicalSegmentation(3, FPSSampler, (20, 8), (8, 16, 16), 4, point_channels=1)
    task = Segmentation(net, 3).eval()
    parts = torch.zeros(2, 40, dtype=torch.int64)
    batch = Batch(points, torch.zeros(2, dtype=torch.int64), parts=parts)
    batch_of_scaled = batch._replace(points=scaled)
    sample = points[:, :9]

    logits = task.predict(batch, sample)
    logits_of_scaled = task.predict(batch_of_scaled, sample)

    assert logits.shape == (2, 40, 3)
    assert_close(logits, logits_of_scaled)
