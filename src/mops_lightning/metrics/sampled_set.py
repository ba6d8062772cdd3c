"""Metrics of the sampled set itself, whatever the task: one number per cloud, to be averaged.

Each takes the points ``(B, N, 3)``, what a sampler made of them, and the sizes of interest: for
size m the first m samples count. It returns ``(B,)`` numbers by size, None where it has no meaning.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.readout import match, unique_count
from mops_lightning.types import SampleOutput

NONZERO_THRESHOLD = 0.01
"""Entries of S below this count as zero (paper, table of the non-zero elements)."""

BySize = dict[int, Tensor]


def subset_distance(points: Tensor, output: SampleOutput, sizes: Sequence[int]) -> BySize:
    """Return (1/m) Σ_j min_i ‖q_j − p_i‖²: the paper's L_subset without its weight.

    In squared units of the input.
    """
    distances = nearest(output.points, points)[0]
    return {m: distances[:, :m].mean(1) for m in sizes}


def unique_points(points: Tensor, output: SampleOutput, sizes: Sequence[int]) -> BySize:
    """Return how many different input points are matched, at most m."""
    indices = match(output.points, points) if output.indices is None else output.indices
    return {m: unique_count(indices[:, :m]).to(points.dtype) for m in sizes}


def nonzero_percent(points: Tensor, output: SampleOutput, sizes: Sequence[int]) -> BySize | None:
    """Return the entries of S that reach 0.01, in percent; None without S."""
    if output.matrix is None:
        return None
    counts = output.matrix.nonzero_counts(NONZERO_THRESHOLD)
    return {m: 100 * counts[:, :m].mean(1) / points.shape[1] for m in sizes}


def orthogonality_error(
    points: Tensor, output: SampleOutput, sizes: Sequence[int]
) -> BySize | None:
    """Return ‖SᵀS − I‖_F, which the paper's Eq. (3) wants small; None without S."""
    if output.matrix is None:
        return None
    gram = output.matrix.gram()
    error = gram - torch.eye(gram.shape[-1]).to(gram)
    return {m: torch.linalg.matrix_norm(error[:, :m, :m]) for m in sizes}


SET_METRICS: dict[str, Callable[[Tensor, SampleOutput, Sequence[int]], BySize | None]] = {
    "generated/subset_distance": subset_distance,
    "matched/unique_points": unique_points,
    "matrix/nonzero_percent": nonzero_percent,
    "matrix/orthogonality_error": orthogonality_error,
}
