"""Losses between rigid motions; each returns its weighted terms by name."""

import math

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.chamfer import chamfer_distance
from mops_lightning.ops.rigid import Motion, quaternion_to_matrix


def quaternion_distance(predicted: Tensor, true: Tensor) -> Tensor:
    """Return the L2 distance of ``(B, 4)`` unit quaternions up to sign, mean over the batch.

    min(‖q̂ − q‖, ‖q̂ + q‖) = 2·sin(θ/4) at the geodesic angle θ: both signs are one rotation, so an
    answer must not be pushed to the far one. Paper section "Registration-oriented Downsampling".
    """
    sign = torch.where((predicted * true).sum(1, keepdim=True) < 0, -1.0, 1.0)
    return torch.linalg.vector_norm(predicted - sign * true, dim=1).mean()


def frobenius_distance(predicted: Tensor, true: Tensor) -> Tensor:
    """Return ‖R̂Rᵀ − I‖²_F of ``(B, 4)`` unit quaternions, mean over the batch."""
    between = quaternion_to_matrix(predicted) @ quaternion_to_matrix(true).mT
    return (between - torch.eye(3).to(between)).square().sum((1, 2)).mean()


def quaternion_loss(
    predicted: Motion,
    true: Motion,
    source: Tensor,
    target: Tensor,
    translation_weight: float = 1.0,
) -> dict[str, Tensor]:
    """The paper's loss, the distance of the quaternions, with one for the translation beside it.

    Args:
        predicted: the answer, for clouds with their centroids at the origin.
        true: the same motion as it should be.
        source: ``(B, N, 3)`` the centred source; not needed.
        target: ``(B, N, 3)`` the centred target; not needed.
        translation_weight: weight of the L2 distance of the translations, which the paper leaves
            out; without it nothing would train that part of the answer.
    """
    _check_weight("translation_weight", translation_weight)
    shift = torch.linalg.vector_norm(predicted.translation - true.translation, dim=1).mean()
    return {
        "quaternion": quaternion_distance(predicted.quaternion, true.quaternion),
        "translation": translation_weight * shift,
    }


def frobenius_chamfer_loss(
    predicted: Motion,
    true: Motion,
    source: Tensor,
    target: Tensor,
    chamfer_weight: float = 1.0,
) -> dict[str, Tensor]:
    """SampleNet's loss for registration: ‖R̂Rᵀ − I‖²_F, and the chamfer distance after the motion.

    Args:
        predicted: the answer, for clouds with their centroids at the origin.
        true: the same motion as it should be.
        source: ``(B, N, 3)`` the centred source, all points.
        target: ``(B, N, 3)`` the centred target, all points.
        chamfer_weight: weight of the chamfer distance.
    """
    _check_weight("chamfer_weight", chamfer_weight)
    chamfer = chamfer_distance(predicted.apply(source), target).mean()
    return {
        "frobenius": frobenius_distance(predicted.quaternion, true.quaternion),
        "chamfer": chamfer_weight * chamfer,
    }


def _check_weight(name: str, value: float) -> None:
    if not 0 <= value < math.inf:
        raise UserError(f"task.loss.{name} must be a number of at least 0, got {value}.")
