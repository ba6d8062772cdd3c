"""Registration of sampled clouds (paper section "Registration-oriented Downsampling")."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor, nn
from torchmetrics import MetricCollection

from mops_lightning.channels import PointChannels, coordinates, with_coordinates
from mops_lightning.errors import UserError
from mops_lightning.metrics import registration
from mops_lightning.metrics.base import collection
from mops_lightning.metrics.registration import RotationError
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.rigid import (
    Motion,
    identity_motion,
    move,
    quaternion_to_matrix,
    random_motion,
)
from mops_lightning.tasks.base import Task, figures_of
from mops_lightning.types import PairBatch, TaskOutput

if TYPE_CHECKING:
    from matplotlib.figure import Figure


ROTATION = 45.0
"""Largest angle about each axis, in degrees, as PCRNet's authors chose it."""
TRANSLATION = 1.0
"""Largest translation along each axis, in units of the coordinates."""


def pair_batch(source: Tensor, target: Tensor, motion: Motion) -> PairBatch:
    """Combine sources and targets into a batch, with every centroid at the origin.

    Args:
        source: ``(B, N, 3 + C)`` the clouds to register.
        target: ``(B, N, 3 + C)`` the clouds to register them to.
        motion: the true motions from source to target.
    """
    both = torch.cat([source, target])
    places = coordinates(both)
    centroids = places.mean(1)
    centred = with_coordinates(both, places - centroids[:, None])
    return PairBatch(centred, centroids, motion.quaternion, motion.translation)


class Registration(Task):
    """Estimates the rigid motion between two clouds from sampled points of both.

    Every cloud becomes a pair. The target is the source under a random motion, with uniform angles
    about the fixed axes x, y and z and a uniform translation (paper section "Registration-oriented
    Downsampling"). Each cloud's centroid is subtracted before sampling; the predicted and scored
    translation applies to the original clouds.

    Args:
        net: maps sources ``(B, M, 3)`` and targets ``(B, M, 3)`` to a ``Motion``.
        resample: number of points of source and target, drawn independently from the shape, so that
            both have different points of one surface; None uses all points in both.
        point_channels: channels of the points, or their number; normals turn with the target.

    Raises:
        UserError: ``resample`` is below 1.
    """

    score = RotationError.name
    net_takes = ("source", "target")
    clouds_per_prediction = 2

    def __init__(
        self,
        net: nn.Module,
        resample: int | None = None,
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__(net)
        self.point_channels = PointChannels.of(point_channels)
        if resample is not None and resample < 1:
            raise UserError(f"resample must be None or at least 1, got {resample}.")
        self.resample = resample

    def make_batch(self, points: Tensor, generators: Sequence[Generator]) -> PairBatch:
        """Convert every cloud to a pair.

        Args:
            points: ``(B, N, 3)``.
            generators: B generators; each determines the pair of its cloud.

        Raises:
            UserError: ``resample`` is larger than N.
        """
        n_points = points.shape[1]
        if self.resample is not None and self.resample > n_points:
            raise UserError(
                f"resample must be at most the {n_points} points of a shape, got {self.resample} "
                "(task.resample and dataset.n_points on the command line)."
            )
        motion = random_motion(ROTATION, TRANSLATION, generators)
        source = points
        target = points
        if self.resample is not None:
            source = self._drawn(points, generators)
            target = self._drawn(points, generators)
        moved = move(target, motion, self.point_channels)
        return pair_batch(source, moved, motion)

    def _drawn(self, points: Tensor, generators: Sequence[Generator]) -> Tensor:
        number = points.shape[1]
        rows = []
        for generator in generators:
            order = torch.randperm(number, generator=generator)
            rows.append(order[: self.resample])
        return gather_points(points, torch.stack(rows))

    def predict(self, batch: PairBatch, points: Tensor) -> Motion:
        """Return the motions between the centred clouds from ``(2B, M, 3)`` points of both."""
        source, target = points.chunk(2)
        return self.net(source, target)

    def disagreement(self, found: Motion, reference: Motion) -> Tensor:
        """Return the squared distance of two motions.

        This is the sum over the unit axes of the squared distance between the rotated axes, plus
        the squared distance of the translations.
        """
        rotation = quaternion_to_matrix(found.quaternion)
        rotation = rotation - quaternion_to_matrix(reference.quaternion)
        translation = found.translation - reference.translation
        of_rotation = rotation.square().sum((1, 2))
        return of_rotation + translation.square().sum(1)

    def step(self, batch: PairBatch, points: Tensor) -> TaskOutput:
        """Register one batch.

        Args:
            batch: pairs.
            points: ``(2B, M, 3)`` sampled from ``batch.points``: sources, then targets.

        Returns:
            The loss terms, the predicted motions and the true ones.
        """
        found = self.predict(batch, points)
        true = Motion(batch.quaternion, batch.translation)
        from_source, from_target = batch.centroids.chunk(2)
        # The true motion between the centred clouds: R·(p + c) + t = R·p + (R·c + t).
        moved_centre = true.apply(from_source[:, None])[:, 0]
        shift = moved_centre - from_target
        losses = quaternion_loss(found, true._replace(translation=shift))
        about_target = found._replace(translation=from_target)
        turned = about_target.apply(-from_source[:, None])[:, 0]
        predicted = Motion(found.quaternion, found.translation + turned)
        return TaskOutput(losses, predicted, true, found)

    def metrics(self, training: bool = False) -> MetricCollection:
        """Return rotation errors in degrees, recalls in [0, 1] and the translation error."""
        return collection(
            RotationError(),
            registration.RotationErrorP90(),
            registration.DoubledRotationError(),
            registration.RotationRecall5(),
            registration.RotationRecall10(),
            registration.TranslationError(),
        )


def quaternion_distance(predicted: Tensor, true: Tensor) -> Tensor:
    """Return the L2 distance between unit quaternions up to sign.

    min(‖q̂ − q‖, ‖q̂ + q‖) = 2·sin(θ/4) for the geodesic angle θ. Both signs are the same rotation,
    so the nearer one is the target. Paper section "Registration-oriented Downsampling".

    Args:
        predicted: ``(B, 4)``.
        true: ``(B, 4)``.

    Returns:
        A scalar, the mean over the batch.
    """
    products = (predicted * true).sum(1, keepdim=True)
    sign = torch.where(products < 0, -1.0, 1.0)
    distances = torch.linalg.vector_norm(predicted - sign * true, dim=1)
    return distances.mean()


def quaternion_loss(predicted: Motion, true: Motion) -> dict[str, Tensor]:
    """Return the paper's quaternion loss and a translation loss.

    Paper section "Registration-oriented Downsampling".

    Args:
        predicted: the predicted motion between centred clouds.
        true: the true motion between centred clouds.

    Returns:
        The terms ``quaternion`` and ``translation``, scalars. The paper does not mention the L2
        distance between translations, but without it they would not be trained.
    """
    difference = predicted.translation - true.translation
    shift = torch.linalg.vector_norm(difference, dim=1).mean()
    return {
        "quaternion": quaternion_distance(predicted.quaternion, true.quaternion),
        "translation": shift,
    }


@figures_of.register(Registration)
def _(
    task: Registration,
    batch: PairBatch,
    samples: Mapping[str, Tensor],
    titles: Sequence[str],
) -> "dict[str, Figure]":
    """Draw the pairs before and after alignment, one column for each readout."""
    from mops_lightning.viz.task_results import RegistrationResult, pair_grid

    source, target = coordinates(batch.points).chunk(2)
    columns = {}
    for name, points in samples.items():
        result = task.step(batch, points)
        motion: Motion = result.output
        of_source, of_target = coordinates(points).chunk(2)
        errors = RotationError.of(result.predictions, result.targets)
        columns[name] = RegistrationResult(
            motion.apply(source),
            motion.apply(of_source),
            of_target,
            errors.tolist(),
        )
    true = Motion(batch.quaternion, batch.translation)
    before = RotationError.of(identity_motion(source), true).tolist()
    return {"pairs": pair_grid(source, target, before, columns, titles)}
