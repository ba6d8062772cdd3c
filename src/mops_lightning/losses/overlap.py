"""Loss on columns of the sampling matrix S that choose the same points."""

from collections.abc import Sequence

import torch

from mops_lightning.ops.sampling_matrix import SamplingMatrix


def overlap_losses(matrix: SamplingMatrix, sizes: Sequence[int]) -> dict[int, torch.Tensor]:
    """Return how far SᵀS of the first m columns is from a diagonal matrix, for several sizes m.

    L_overlap(S) = 1/m Σ_{i≠j} (SᵀS)_ij², averaged over the clouds. The columns of an ideal sampling
    matrix are orthogonal (paper section "Problem Formulation", Eq. 2); two columns that choose the
    same point give two generated points with the same match.

    Args:
        matrix: S of every cloud, with at least max(sizes) columns. Its N·M entries are computed.
        sizes: sizes m, each from 1 to M.

    Returns:
        Scalars by size, without unit; 0 where no point has weight in two columns.
    """
    columns = matrix.leftmost(max(sizes)).dense().mT
    squares = (columns @ columns.mT).square()
    squares = squares - squares.diagonal(dim1=1, dim2=2).diag_embed()
    return {m: squares[:, :m, :m].sum((1, 2)).mean() / m for m in sizes}
