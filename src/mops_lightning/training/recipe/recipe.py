"""Additions to the published training of a sampler."""

from dataclasses import dataclass

import torch
from torch import Tensor

from mops_lightning.errors import UserError, check_at_least
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.readout import match
from mops_lightning.types import Batch, PairBatch

POINTS_PER_SAMPLE = 2
"""A training step sees at least this many times the number of sampled points."""


@dataclass(frozen=True)
class Recipe:
    """Settings that make training cheaper or better; the defaults change nothing.

    Shares are of the training steps of the whole run, from 0 to 1.

    Attributes:
        train_points: points of a cloud that a training step sees, drawn in every step, and at
            least twice the sampled ones; None: all. Validation and test always see all.
        task_points: the same for the task net, trained alone, also before a sampler's training.
        all_points_from: share after which training steps see all points; None: never.
        warm_start: whether the sampler's first layers start as copies of the task net's; or the
            weights file of a trained sampler, of any size, to start from.
        distillation: weight of the disagreement between the frozen task net's predictions on the
            sample and on all points, after augmentation; see ``Task.disagreement``. Only with
            ``learn="sampler"``.
        feature_distillation: weight of the distance between the frozen task net's max-pooled
            features of the sample and of the points that the step sees.
            Only with ``learn="sampler"`` and a net with ``point_features``.
        straight_through: share after which the task net also sees matched points, whose gradients
            go to the generated ones; None: never.
        ema_span: time constant of an exponential moving average of the weights, as a share; the
            average is validated, tested and saved. None: the last weights are.
        nets_per_step: how many of ``other_nets``, drawn anew, a step computes its losses under,
            besides the run's own net; None: all.

    Raises:
        UserError: an attribute is out of range.
    """

    train_points: int | None = None
    task_points: int | None = None
    all_points_from: float | None = None
    warm_start: bool | str = False
    distillation: float = 0.0
    feature_distillation: float = 0.0
    straight_through: float | None = None
    ema_span: float | None = None
    nets_per_step: int | None = None

    def __post_init__(self) -> None:
        """Check the attributes."""
        for name in ("train_points", "task_points", "nets_per_step"):
            number = getattr(self, name)
            if number is not None and number < 1:
                raise UserError(f"{name} must be at least 1 or null, got {number}.")
        for name in ("all_points_from", "straight_through", "ema_span"):
            share = getattr(self, name)
            if share is not None and not 0 <= share <= 1:
                raise UserError(f"{name} must be between 0 and 1 or null, got {share}.")
        check_at_least(
            0, distillation=self.distillation, feature_distillation=self.feature_distillation
        )

    def points_at(self, progress: float, available: int, largest: int) -> int:
        """Return how many points of a cloud a step sees.

        Args:
            progress: share of the training before this step.
            available: points per cloud.
            largest: the largest number of points that this step samples; 0: the task net is
                trained alone.
        """
        if not largest:
            return min(available, self.task_points or available)
        if self.train_points is None or reached(self.all_points_from, progress):
            return available
        return min(available, max(self.train_points, POINTS_PER_SAMPLE * largest))

    def sees_matched(self, progress: float) -> bool:
        """Return whether the task net also sees matched points."""
        return reached(self.straight_through, progress)


def reached(share: float | None, progress: float) -> bool:
    """Return whether training has come to a share of its steps; never for None."""
    return share is not None and progress >= share


def draw_points(batch: Batch | PairBatch, n: int) -> Tensor:
    """Return ``n`` random points of every cloud of a batch, without repetition.

    The clouds of a pair keep the same rows. Random numbers are from torch's global generator.

    Args:
        batch: ``Batch`` or ``PairBatch``.
        n: at most the number of points.
    """
    points = batch.points
    if n >= points.shape[1]:
        return points
    clouds = batch.num_clouds
    numbers = torch.rand(clouds, points.shape[1], device=points.device)
    rows = numbers.topk(n).indices
    rows = rows.repeat(len(points) // clouds, 1)
    return gather_points(points, rows)


def straight_through(generated: Tensor, points: Tensor) -> Tensor:
    """Return the matched points with the gradients of the generated ones.

    Args:
        generated: ``(B, M, 3)``.
        points: ``(B, N, 3)`` the clouds.

    Returns:
        ``(B, M, 3)``.
    """
    matched = gather_points(points, match(generated, points))
    return generated + (matched - generated).detach()
