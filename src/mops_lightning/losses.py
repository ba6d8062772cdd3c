"""Losses that are no part of a task: pure functions."""

from torch import Tensor

from mops_lightning.geometry import nearest


def subset_loss(points: Tensor, samples: Tensor) -> Tensor:
    """Measure how far generated points are from being a subset of the cloud.

    L_subset(P, Q) = 1/m Σ_j min_i ‖q_j − p_i‖², paper section "Joint Training Loss"; here its mean
    over the clouds.

    Args:
        points: ``(B, N, 3)`` the clouds P.
        samples: ``(B, M, 3)`` the generated points Q.

    Returns:
        A scalar in squared units of the coordinates; 0 where every sample is an input point.
    """
    return nearest(samples, points)[0].mean()
