"""Registration of scans: two halves of a crop, aligned by ICP from a drawn start."""

from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional as F
from torchmetrics import MetricCollection

from mops_lightning.channels import coordinates
from mops_lightning.errors import UserError, check_at_least
from mops_lightning.metrics import registration
from mops_lightning.metrics.base import collection
from mops_lightning.nets.plane_icp import surface_normals
from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.rigid import Motion, motion_of_vectors
from mops_lightning.tasks.registration import Registration
from mops_lightning.types import PairBatch, SampleOutput

MOTIONS = 4
"""Drawn motions from which a step of training finds correspondences."""


class ScanRegistration(Registration):
    """Registers a sample of one half of a cloud to the other half, from a drawn start.

    The halves share no point. The source starts turned about the cloud's mean by an angle that is
    uniform from 0 to ``angle``, about a random axis, and shifted by up to ``shift``. The net
    registers sampled source points to all points of the target.

    A sampler that predicts residuals (``SampleOutput.log_residuals``) is trained to do so. The
    residual of a point is its distance, at the true pose, from the plane of the target point that
    was nearest after a drawn motion, or ``max_distance`` where that point was farther away. The
    loss is the negative log likelihood of Laplace's distribution, up to a constant.

    Args:
        net: maps sources ``(B, M, 3)`` and targets ``(B, N, 3)`` to a ``Motion``.
        angle: largest angle of a start, in degrees.
        shift: largest shift of a start, in the clouds' unit.
        max_distance: largest residual, in the clouds' unit.

    Raises:
        UserError: an argument is out of range.
    """

    score = registration.MedianRotationError.name
    knows_residuals = True

    def __init__(
        self,
        net: nn.Module,
        angle: float = 15.0,
        shift: float = 0.1,
        max_distance: float = 0.3,
    ) -> None:
        super().__init__(net)
        check_at_least(0, angle=angle, shift=shift)
        if not 0 < max_distance < float("inf"):
            raise UserError(f"max_distance must be a number above 0, got {max_distance}.")
        self.angle = angle
        self.shift = shift
        self.max_distance = max_distance

    def make_batch(self, points: Tensor, generators: Sequence[Generator]) -> PairBatch:
        """Split every cloud into two halves, and move the target.

        Args:
            points: ``(B, N, 3)``.
            generators: B generators; each determines the pair of its cloud.

        Raises:
            UserError: a cloud has fewer than two points.
        """
        number = points.shape[1]
        half = number // 2
        if half < 1:
            raise UserError(f"task=icp needs clouds of two points or more, got {number}.")
        orders = [torch.randperm(number, generator=generator) for generator in generators]
        rows = torch.stack(orders)
        source = gather_points(points, rows[:, :half])
        target = gather_points(points, rows[:, half : 2 * half])
        directions = [torch.randn(6, generator=generator) for generator in generators]
        sizes = [torch.rand(2, generator=generator) for generator in generators]
        motion = self._motion(torch.stack(directions), torch.stack(sizes))
        moved = motion.apply(coordinates(target))
        both = torch.cat([source, moved])
        still = torch.zeros(len(both), 3)
        return PairBatch(both, still, motion.quaternion, motion.translation)

    def _motion(self, directions: Tensor, sizes: Tensor) -> Motion:
        """Return motions from directions ``(B, 6)`` and shares ``(B, 2)`` of the largest ones."""
        axis = F.normalize(directions[:, :3], dim=1)
        along = F.normalize(directions[:, 3:], dim=1)
        angle = torch.deg2rad(sizes[:, :1] * self.angle)
        shift = along * sizes[:, 1:] * self.shift
        return motion_of_vectors(axis * angle, shift)

    def predict(self, batch: PairBatch, points: Tensor) -> Motion:
        """Return the motions from sampled sources, of ``(2B, M, 3)`` points, to whole targets."""
        source, _ = coordinates(points).chunk(2)
        _, target = coordinates(batch.points).chunk(2)
        motion: Motion = self.net(source, target)
        return motion

    def sample_losses(
        self, batch: PairBatch, seen: Tensor, output: SampleOutput
    ) -> dict[str, Tensor]:
        """Return the loss of predicted residuals; see the class."""
        if output.log_residuals is None:
            return {}
        expected = output.log_residuals
        found = self.residuals(batch, seen)
        precision = (-expected).exp()
        losses = found * precision[:, None] + expected[:, None]
        return {"residual": losses.mean()}

    @torch.no_grad()
    def residuals(self, batch: PairBatch, seen: Tensor) -> Tensor:
        """Return the residuals ``(2B, MOTIONS, K)`` of points of both halves, under drawn motions.

        The motions grow from none to those of a start; they are drawn from torch's global
        generator.

        Args:
            batch: pairs, whose whole halves have the corresponding points.
            seen: ``(2B, K, 3)`` points of the sources, then of the targets.
        """
        source, target = coordinates(batch.points).chunk(2)
        seen_source, seen_target = coordinates(seen).chunk(2)
        true = Motion(batch.quaternion, batch.translation)
        clouds = torch.cat([true.apply(seen_source), seen_target])
        others = torch.cat([target, true.apply(source)])
        normals = surface_normals(others)
        residuals = []
        for number in range(MOTIONS):
            share = number / (MOTIONS - 1)
            sizes = share * torch.rand(len(clouds), 2)
            directions = torch.randn(len(clouds), 6)
            motion = self._motion(directions, sizes)
            residuals.append(self._residuals(clouds, motion, others, normals))
        return torch.stack(residuals, 1)

    def _residuals(self, clouds: Tensor, motion: Motion, others: Tensor, normals: Tensor) -> Tensor:
        """Return the residuals ``(B, N)`` for the correspondences after one motion."""
        squared, rows = nearest(motion.apply(clouds), others)
        apart = clouds - gather_points(others, rows)
        across = (apart * gather_points(normals, rows)).sum(2)
        is_near = squared.sqrt() <= self.max_distance
        return across.abs().where(is_near, self.max_distance)

    def metrics(self, training: bool = False) -> MetricCollection:
        """Return rotation errors in degrees, the share below 2° and the translation error."""
        return collection(
            registration.MedianRotationError(),
            registration.RotationError(),
            registration.RotationRecall2(),
            registration.TranslationError(),
        )
