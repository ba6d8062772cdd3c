"""How far predicted rigid motions are from the true ones, over all pairs of a test."""

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from mops_lightning.errors import UserError
from mops_lightning.ops.rigid import Motion, rotation_angle


class RotationError(Metric):
    """Mean or a quantile of the geodesic angle between predicted and true rotations, in degrees.

    Args:
        quantile: between 0 and 1; None takes the mean.
        factor: what the angles are multiplied by. The code of PCRNet and SampleNet reports
            2·acos(2⟨q₁, q₂⟩² − 1), twice the geodesic angle: ``factor=2`` gives its figure.

    Raises:
        UserError: ``quantile`` is out of range.

    Example:
        >>> from mops_lightning.ops.rigid import Motion
        >>> still = Motion(torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3))
        >>> half_turn = Motion(torch.tensor([[0.0, 1, 0, 0]]), torch.zeros(1, 3))
        >>> RotationError()(half_turn, still)
        tensor(180.)
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False
    angles: list[Tensor]

    def __init__(self, quantile: float | None = None, factor: float = 1.0, **extra: Any) -> None:
        super().__init__(**extra)
        if quantile is not None and not 0 <= quantile <= 1:
            raise UserError(f"quantile must be between 0 and 1, got {quantile}.")
        self.quantile = quantile
        self.factor = factor
        self.add_state("angles", default=[], dist_reduce_fx="cat")

    @staticmethod
    def of(predicted: Motion, true: Motion) -> Tensor:
        """Return ``(B,)`` geodesic angles in degrees, from 0 to 180."""
        return torch.rad2deg(rotation_angle(predicted.quaternion.detach(), true.quaternion))

    def update(self, predicted: Motion, true: Motion) -> None:
        """Take in a batch of motions."""
        self.angles.append(self.of(predicted, true))

    def compute(self) -> Tensor:
        """Return the mean or the quantile over all pairs so far."""
        angles = self.factor * dim_zero_cat(self.angles).double()
        value = angles.mean() if self.quantile is None else angles.quantile(self.quantile)
        return value.float()


class RotationRecall(Metric):
    """Share of pairs whose geodesic rotation error is at most ``degrees``.

    Args:
        degrees: the limit.
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False
    within: Tensor
    pairs: Tensor

    def __init__(self, degrees: float, **extra: Any) -> None:
        super().__init__(**extra)
        self.degrees = degrees
        self.add_state("within", default=torch.tensor(0), dist_reduce_fx="sum")
        self.add_state("pairs", default=torch.tensor(0), dist_reduce_fx="sum")

    def update(self, predicted: Motion, true: Motion) -> None:
        """Take in a batch of motions."""
        angles = RotationError.of(predicted, true)
        self.within += (angles <= self.degrees).sum()
        self.pairs += len(angles)

    def compute(self) -> Tensor:
        """Return the share over all pairs so far."""
        return self.within / self.pairs


class TranslationError(Metric):
    """Mean Euclidean distance of predicted and true translations, in units of the coordinates."""

    is_differentiable = False
    higher_is_better = False
    full_state_update = False
    total: Tensor
    pairs: Tensor

    def __init__(self, **extra: Any) -> None:
        super().__init__(**extra)
        self.add_state("total", default=torch.tensor(0.0), dist_reduce_fx="sum")
        self.add_state("pairs", default=torch.tensor(0), dist_reduce_fx="sum")

    def update(self, predicted: Motion, true: Motion) -> None:
        """Take in a batch of motions."""
        difference = predicted.translation.detach() - true.translation
        self.total += torch.linalg.vector_norm(difference, dim=1).sum()
        self.pairs += len(difference)

    def compute(self) -> Tensor:
        """Return the mean over all pairs so far."""
        return self.total / self.pairs
