"""Metrics of the sampled set itself, whatever the task: one number per cloud, to be averaged."""

from collections.abc import Callable

import torch
from torch import Tensor

from mops_lightning.geometry import nearest
from mops_lightning.readout import match, unique_count
from mops_lightning.types import SampleOutput

NONZERO_THRESHOLD = 0.01
"""Entries of S below this count as zero (paper, table of the non-zero elements)."""


def subset_distance(points: Tensor, output: SampleOutput) -> Tensor:
    """Return (1/M) Σ_j min_i ‖q_j − p_i‖² per cloud: the paper's L_subset without its weight.

    Args:
        points: ``(B, N, 3)`` input.
        output: what the sampler made of it.

    Returns:
        ``(B,)``, in squared units of the input.
    """
    return nearest(output.points, points)[0].mean(1)


def unique_points(points: Tensor, output: SampleOutput) -> Tensor:
    """Return how many different input points are matched, at most M, per cloud: ``(B,)``."""
    indices = match(output.points, points) if output.indices is None else output.indices
    return unique_count(indices).to(points.dtype)


def nonzero_percent(points: Tensor, output: SampleOutput) -> Tensor | None:
    """Return the entries of S that reach 0.01, in percent, per cloud; None without S."""
    if output.matrix is None:
        return None
    return 100 * output.matrix.nonzero_share(NONZERO_THRESHOLD)


def orthogonality_error(points: Tensor, output: SampleOutput) -> Tensor | None:
    """Return ‖SᵀS − I‖_F per cloud, which the paper's Eq. (3) wants small; None without S."""
    if output.matrix is None:
        return None
    gram = output.matrix.gram()
    return torch.linalg.matrix_norm(gram - torch.eye(gram.shape[-1]).to(gram))


SET_METRICS: dict[str, Callable[[Tensor, SampleOutput], Tensor | None]] = {
    "generated/subset_distance": subset_distance,
    "matched/unique_points": unique_points,
    "matrix/nonzero_percent": nonzero_percent,
    "matrix/orthogonality_error": orthogonality_error,
}
