"""Plain geometry."""

import torch
from torch import Tensor


def gather_points(points: Tensor, indices: Tensor) -> Tensor:
    """Return ``(B, M, C)`` rows of ``(B, N, C)`` points."""
    return points.gather(1, indices[..., None].expand(-1, -1, points.shape[2]))


def nearest(queries: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return squared distance and index of the nearest point of each query."""
    with torch.no_grad():
        found = torch.cdist(
            queries, points, compute_mode="donot_use_mm_for_euclid_dist"
        ).argmin(-1)
    return (queries - gather_points(points, found)).square().sum(-1), found
