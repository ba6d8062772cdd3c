"""Errors of predicted rigid motions, over all pairs of a test."""

from typing import Any, ClassVar

import torch
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from mops_lightning.metrics.base import MeanOverClouds, TableMetric
from mops_lightning.ops.rigid import Motion, rotation_angle


class RotationError(TableMetric):
    """Mean geodesic angle between predicted and true rotations, in degrees.

    Attributes:
        quantile: between 0 and 1; None takes the mean.
        factor: multiplies the angles.

    Examples:
        >>> from mops_lightning.ops.rigid import Motion
        >>> still = Motion(torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3))
        >>> half_turn = Motion(torch.tensor([[0.0, 1, 0, 0]]), torch.zeros(1, 3))
        >>> RotationError()(half_turn, still)
        tensor(180.)
    """

    name = "rotation_error_deg"
    label = "rotation error"
    unit = "°"
    higher_is_better = False
    summary_order: ClassVar[int | None] = 1
    quantile: ClassVar[float | None] = None
    factor: ClassVar[float] = 1.0
    angles: list[Tensor]

    def __init__(self, **extra: Any) -> None:
        super().__init__(**extra)
        self.add_state("angles", default=[], dist_reduce_fx="cat")

    @staticmethod
    def of(predicted: Motion, true: Motion) -> Tensor:
        """Return ``(B,)`` geodesic angles in degrees, from 0 to 180."""
        return torch.rad2deg(rotation_angle(predicted.quaternion.detach(), true.quaternion))

    def update(self, predicted: Motion, true: Motion) -> None:
        """Add a batch of motions."""
        self.angles.append(self.of(predicted, true))

    def compute(self) -> Tensor:
        """Return the mean or the quantile over all pairs so far."""
        angles = self.factor * dim_zero_cat(self.angles).double()
        if self.quantile is None:
            return angles.mean().float()
        return angles.quantile(self.quantile).float()


class MedianRotationError(RotationError):
    """Median of the rotation errors, in degrees, for registrations of which some fail."""

    name = "median_rotation_error_deg"
    label = "median rotation error"
    summary_order = 0
    quantile = 0.5


class RotationErrorP90(RotationError):
    """90th percentile of the rotation errors, in degrees."""

    name = "rotation_error_p90_deg"
    label = "rotation error p90"
    summary_order = 2
    quantile = 0.9


class DoubledRotationError(RotationError):
    """Twice the mean rotation error, in degrees.

    SampleNet's registration code reports it: 2·acos(2⟨q₁, q₂⟩² − 1). The geodesic angle is
    acos(2⟨q₁, q₂⟩² − 1).
    """

    name = "rotation_error_doubled_deg"
    label = "rotation error doubled"
    summary_order = None
    factor = 2.0


class RotationRecall(MeanOverClouds):
    """Fraction of pairs whose geodesic rotation error is at most ``degrees``.

    Attributes:
        degrees: the limit.
    """

    unit = "%"
    scale = 100.0
    higher_is_better = True
    degrees: ClassVar[float]

    def update(self, predicted: Motion, true: Motion) -> None:
        """Add a batch of motions."""
        self.add(RotationError.of(predicted, true) <= self.degrees)


class RotationRecall2(RotationRecall):
    """Recall at 2 degrees."""

    name = "rotation_recall_2deg"
    summary_order = 3
    degrees = 2.0


class RotationRecall5(RotationRecall):
    """Recall at 5 degrees."""

    name = "rotation_recall_5deg"
    summary_order = 3
    degrees = 5.0


class RotationRecall10(RotationRecall):
    """Recall at 10 degrees."""

    name = "rotation_recall_10deg"
    summary_order = 4
    degrees = 10.0


class TranslationError(MeanOverClouds):
    """Mean Euclidean distance of predicted and true translations, in units of the coordinates."""

    name = "translation_error"
    higher_is_better = False
    summary_order = 5

    def update(self, predicted: Motion, true: Motion) -> None:
        """Add a batch of motions."""
        difference = predicted.translation.detach() - true.translation
        self.add(torch.linalg.vector_norm(difference, dim=1))
