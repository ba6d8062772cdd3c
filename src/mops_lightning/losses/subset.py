"""Losses of generated points: subset and simplification loss, and overlap of the columns of S.

Nested samplers are trained at several sizes: the first m points are the sample of size m. Every
function computes the losses of all sizes at little more than the cost of the largest.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mops_lightning.channels import coordinates
from mops_lightning.ops.local_matrix import LocalMatrix
from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.sampling_matrix import SamplingMatrix


def subset_losses(points: Tensor, samples: Tensor, sizes: Sequence[int]) -> dict[int, Tensor]:
    """Return the mean squared distance of the first m samples to their nearest input points.

    L_subset(P, Q) = 1/m Σ_j min_i ‖q_j − p_i‖² (paper section "Joint Training Loss", Eq. 10),
    averaged over the clouds.

    Args:
        points: ``(B, N, 3 + C)`` clouds P; distances are between coordinates.
        samples: ``(B, M, 3 + C)`` generated points Q.
        sizes: sizes m, each from 1 to M.

    Returns:
        Scalars by size, in squared units of the coordinates; 0 if every sample is an input point.
    """
    distances, _ = nearest(coordinates(samples), coordinates(points))
    return {m: distances[:, :m].mean() for m in sizes}


def simplification_losses(
    points: Tensor,
    samples: Tensor,
    sizes: Sequence[int],
    coverage: float = 1.0,
    coverage_per_point: float = 0.0,
) -> dict[int, Tensor]:
    """Return the simplification loss of S-Net and SampleNet for the first m samples.

    L_simplify(Q, P) = mean_q d²(q, P) + max_q d²(q, P) + (γ + δ·m)·mean_p d²(p, Q), where d² is the
    squared distance to the nearest point of the other set, averaged over the clouds (Dovrat et al.,
    CVPR 2019, section "Loss"; Lang et al., CVPR 2020).

    Args:
        points: ``(B, N, 3 + C)`` clouds P; distances are between coordinates.
        samples: ``(B, M, 3 + C)`` generated points Q.
        sizes: sizes m, each from 1 to M.
        coverage: γ.
        coverage_per_point: δ.

    Returns:
        Scalars by size, in squared units of the coordinates.
    """
    points = coordinates(points)
    samples = coordinates(samples)
    to_cloud, _ = nearest(samples, points)
    losses = {}
    begin = 0
    from_cloud = None
    for m in sorted(set(sizes)):
        # The nearest of the first m is the nearest of the previous size or of the added points.
        added, _ = nearest(points, samples[:, begin:m])
        if from_cloud is None:
            from_cloud = added
        else:
            from_cloud = torch.minimum(from_cloud, added)
        begin = m
        of_first = to_cloud[:, :m]
        sample_terms = of_first.mean(1) + of_first.amax(1)
        weight = coverage + coverage_per_point * m
        terms = sample_terms + weight * from_cloud.mean(1)
        losses[m] = terms.mean()
    return losses


def overlap_losses(matrix: SamplingMatrix | LocalMatrix, sizes: Sequence[int]) -> dict[int, Tensor]:
    """Return how far SᵀS of the first m columns is from a diagonal matrix.

    L_overlap(S) = 1/m Σ_{i≠j} (SᵀS)_ij², averaged over the clouds. The columns of an ideal sampling
    matrix are orthogonal (paper section "Problem Formulation", Eq. 2); two columns that choose the
    same point give two generated points with the same match.

    Args:
        matrix: S of every cloud, with at least max(sizes) columns. All its entries are computed:
            N·M, or M·k of local columns.
        sizes: sizes m, each from 1 to M.

    Returns:
        Scalars by size, without unit; 0 where no point has weight in two columns.
    """
    matrix = matrix.leftmost(max(sizes))
    if isinstance(matrix, LocalMatrix):
        squares = matrix.products().square()
    else:
        columns = matrix.dense().mT
        squares = (columns @ columns.mT).square()
    diagonal = squares.diagonal(dim1=1, dim2=2)
    squares = squares - diagonal.diag_embed()
    losses = {}
    for m in sizes:
        of_clouds = squares[:, :m, :m].sum((1, 2))
        losses[m] = of_clouds.mean() / m
    return losses
