"""Tasks on points with channels beside x, y and z."""

import torch
from torch.nn import functional as F

from mops_lightning.channels import Channel, PointChannels
from mops_lightning.nets.autoencoder import AutoEncoder
from mops_lightning.nets.hierarchical import HierarchicalSegmentation
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.ops.rigid import Motion, quaternion_to_matrix
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.tasks.reconstruction import Reconstruction
from mops_lightning.tasks.registration import Registration
from mops_lightning.tasks.segmentation import Segmentation
from mops_lightning.types import Batch

WITH_NORMALS = PointChannels(
    (Channel("intensity"), Channel("normal_x"), Channel("normal_y"), Channel("normal_z"))
)


def test_pairs_turn_normals_with_the_target_and_centre_coordinates_only(rng):
    points = torch.randn(2, 30, 7, generator=rng)
    points[..., 4:] = F.normalize(points[..., 4:], dim=2)
    net = PCRNet(feature_channels=(8, 16), point_channels=WITH_NORMALS)
    task = Registration(net, point_channels=WITH_NORMALS)
    without = Registration(PCRNet(feature_channels=(8, 16)))
    seeds = [torch.Generator().manual_seed(seed) for seed in (0, 1)]
    same_seeds = [torch.Generator().manual_seed(seed) for seed in (0, 1)]

    batch = task.make_batch(points, seeds)

    expected = without.make_batch(points[..., :3].contiguous(), same_seeds)
    torch.testing.assert_close(batch.points[..., :3], expected.points)
    torch.testing.assert_close(batch.centroids, expected.centroids)
    source, target = batch.points.chunk(2)
    rotation = quaternion_to_matrix(Motion(batch.quaternion, batch.translation).quaternion)
    assert torch.equal(source[..., 3:], points[..., 3:])
    assert torch.equal(target[..., 3], points[..., 3])
    torch.testing.assert_close(target[..., 4:], points[..., 4:] @ rotation.mT)
    losses = task.step(batch, batch.points[:, :9]).losses
    assert all(loss.isfinite() for loss in losses.values())


def test_reconstruction_compares_coordinates(rng):
    points = torch.randn(2, 40, 5, generator=rng)
    task = Reconstruction(AutoEncoder(40, 16, (8, 8), point_channels=2), exact_up_to=None).eval()
    batch = Batch(points, torch.zeros(2, dtype=torch.int64))
    other_channels = batch._replace(points=torch.cat([points[..., :3], -points[..., 3:]], 2))
    sample = points[:, :9]

    step = task.step(batch, sample)
    scores = task.scores(batch, {"first": sample})["first"]

    assert step.output.shape == (2, 40, 3)
    torch.testing.assert_close(step.losses, task.step(other_channels, sample).losses)
    torch.testing.assert_close(scores.losses["chamfer"], step.losses["chamfer"])


def test_segmentation_interpolates_by_coordinates(rng):
    points = torch.randn(2, 40, 4, generator=rng)
    net = HierarchicalSegmentation(3, FPSSampler, (20, 8), (8, 16, 16), 4, point_channels=1)
    task = Segmentation(net, 3).eval()
    parts = torch.zeros(2, 40, dtype=torch.int64)
    batch = Batch(points, torch.zeros(2, dtype=torch.int64), parts=parts)
    scaled = points.clone()
    scaled[..., 3] *= 100
    sample = points[:, :9]

    result = task.predict(batch, sample)

    assert result.shape == (2, 40, 3)
    torch.testing.assert_close(result, task.predict(batch._replace(points=scaled), sample))
