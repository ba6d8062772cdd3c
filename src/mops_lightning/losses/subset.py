"""Losses between generated points and the input cloud: subset and simplification loss.

Nested samplers are trained at several sizes: the first m points are the sample of size m.
``subset_losses`` and ``simplification_losses`` compute the losses of all sizes at little more than
the cost of the largest.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mops_lightning.ops.nearest import nearest_distances


def subset_loss(points: Tensor, samples: Tensor) -> Tensor:
    """Return the subset loss: the mean squared distance of samples to their nearest input point.

    L_subset(P, Q) = 1/m Σ_j min_i ‖q_j − p_i‖² (paper section "Joint Training Loss", Eq. 10),
    averaged over the clouds.

    Args:
        points: ``(B, N, 3)`` clouds P.
        samples: ``(B, M, 3)`` generated points Q.

    Returns:
        A scalar in squared units of the coordinates; 0 if every sample is an input point.
    """
    return subset_losses(points, samples, (samples.shape[1],))[samples.shape[1]]


def subset_losses(points: Tensor, samples: Tensor, sizes: Sequence[int]) -> dict[int, Tensor]:
    """Return ``subset_loss`` of the first m samples for several sizes m.

    Args:
        points: ``(B, N, 3)`` clouds P.
        samples: ``(B, M, 3)`` generated points Q.
        sizes: sizes m, each from 1 to M.

    Returns:
        Scalars by size.
    """
    distances = nearest_distances(samples, points)
    return {m: distances[:, :m].mean() for m in sizes}


def simplification_loss(
    points: Tensor, samples: Tensor, coverage: float = 1.0, coverage_per_point: float = 0.0
) -> Tensor:
    """Return the simplification loss of S-Net and SampleNet.

    L_simplify(Q, P) = mean_q d²(q, P) + max_q d²(q, P) + (γ + δ·M)·mean_p d²(p, Q), where d² is the
    squared distance to the nearest point of the other set, averaged over the clouds (Dovrat et al.,
    CVPR 2019, section "Loss"; Lang et al., CVPR 2020).

    Args:
        points: ``(B, N, 3)`` clouds P.
        samples: ``(B, M, 3)`` generated points Q.
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
    """Return ``simplification_loss`` of the first m samples for several sizes m.

    Args:
        points: ``(B, N, 3)`` clouds P.
        samples: ``(B, M, 3)`` generated points Q.
        sizes: sizes m, each from 1 to M.
        coverage: γ.
        coverage_per_point: δ.

    Returns:
        Scalars by size.
    """
    to_cloud = nearest_distances(samples, points)
    losses, begin, from_cloud = {}, 0, None
    for m in sorted(set(sizes)):
        # The nearest of the first m is the nearest of the previous size or of the added points.
        added = nearest_distances(points, samples[:, begin:m])
        from_cloud = added if from_cloud is None else torch.minimum(from_cloud, added)
        begin = m
        sample_terms = to_cloud[:, :m].mean(1) + to_cloud[:, :m].amax(1)
        weight = coverage + coverage_per_point * m
        losses[m] = (sample_terms + weight * from_cloud.mean(1)).mean()
    return losses
