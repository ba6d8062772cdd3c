"""The paper's registration loss."""

import torch
from torch import Tensor

from mops_lightning.ops.rigid import Motion


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
    sign = torch.where((predicted * true).sum(1, keepdim=True) < 0, -1.0, 1.0)
    return torch.linalg.vector_norm(predicted - sign * true, dim=1).mean()


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
    shift = torch.linalg.vector_norm(predicted.translation - true.translation, dim=1).mean()
    return {
        "quaternion": quaternion_distance(predicted.quaternion, true.quaternion),
        "translation": shift,
    }
