"""Losses that are no part of a task, and distances of clouds: pure functions.

Nested samplers are trained at several sizes of one sample, whose first m points count for size m.
The functions in the plural give the losses of all sizes for little more than the largest costs.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mops_lightning.ops.nearest import nearest_distances


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
    return subset_losses(points, samples, (samples.shape[1],))[samples.shape[1]]


def subset_losses(points: Tensor, samples: Tensor, sizes: Sequence[int]) -> dict[int, Tensor]:
    """Return, by size m, the ``subset_loss`` of the first m samples."""
    distances = nearest_distances(samples, points)
    return {m: distances[:, :m].mean() for m in sizes}


def simplification_loss(
    points: Tensor, samples: Tensor, coverage: float = 1.0, coverage_per_point: float = 0.0
) -> Tensor:
    """Measure how far generated points are from the cloud, and the cloud from them.

    L_simplify(Q, P) = mean_q d²(q, P) + max_q d²(q, P) + (γ + δ·M)·mean_p d²(p, Q), with d² the
    squared distance to the nearest point of the other set; its mean over the clouds. S-Net (Dovrat
    et al., CVPR 2019, section "Loss") and SampleNet (Lang et al., CVPR 2020) train with it.

    Args:
        points: ``(B, N, 3)`` the clouds P.
        samples: ``(B, M, 3)`` the generated points Q.
        coverage: γ.
        coverage_per_point: δ.

    Returns:
        A scalar in squared units of the coordinates.
    """
    size = samples.shape[1]
    return simplification_losses(points, samples, (size,), coverage, coverage_per_point)[size]


def simplification_losses(
    points: Tensor,
    samples: Tensor,
    sizes: Sequence[int],
    coverage: float = 1.0,
    coverage_per_point: float = 0.0,
) -> dict[int, Tensor]:
    """Return, by size m, the ``simplification_loss`` of the first m samples."""
    to_cloud = nearest_distances(samples, points)
    losses, begin, from_cloud = {}, 0, None
    for m in sorted(set(sizes)):
        # Nearest among the first m: nearest among the smaller size, or among what is added to it.
        added = nearest_distances(points, samples[:, begin:m])
        from_cloud = added if from_cloud is None else torch.minimum(from_cloud, added)
        begin = m
        there = to_cloud[:, :m].mean(1) + to_cloud[:, :m].amax(1)
        weight = coverage + coverage_per_point * m
        losses[m] = (there + weight * from_cloud.mean(1)).mean()
    return losses
