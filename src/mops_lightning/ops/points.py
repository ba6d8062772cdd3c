"""Gathering, normalisation and memory layout of batched point clouds."""

import torch
from torch import Tensor
from torch.nn import functional as F

from mops_lightning.ops.argextreme import GROUP


def gather_points(points: Tensor, indices: Tensor) -> Tensor:
    """Select rows of every cloud.

    Args:
        points: ``(B, N, C)``.
        indices: ``(B, M)`` int64, rows of ``points``.

    Returns:
        ``(B, M, C)``; gradients flow to ``points``.
    """
    return points.gather(1, indices[..., None].expand(-1, -1, points.shape[2]))


def normalize_unit_sphere(points: Tensor) -> Tensor:
    """Centre every cloud at the origin and scale its largest norm to 1.

    Args:
        points: ``(B, N, C)``.

    Returns:
        ``(B, N, C)``; a cloud whose points all coincide becomes zeros.
    """
    centred = points - points.mean(1, keepdim=True)
    radius = torch.linalg.vector_norm(centred, dim=2, keepdim=True).amax(1, keepdim=True)
    # The mean of equal numbers can have a rounding error, which must not be scaled up.
    flat = (points == points[:, :1]).all(2, keepdim=True).all(1, keepdim=True) | (radius == 0)
    return torch.where(flat, 0.0, centred / torch.where(flat, 1.0, radius))


def distance_dtype(points: Tensor) -> torch.dtype:
    """Return the dtype for comparing distances: at least float32, as half is too coarse."""
    return torch.promote_types(points.dtype, torch.float32)


def to_planes(points: Tensor, padding: float | None = None) -> Tensor:
    """Convert ``(B, N, C)`` to contiguous ``(C, B, N)``, one plane per coordinate.

    Args:
        points: ``(B, N, C)``.
        padding: value that pads N to a multiple of ``GROUP``; None adds no padding.

    Returns:
        ``(C, B, N)``, or ``(C, B, N')`` with padding.
    """
    planes = points.permute(2, 0, 1)
    if padding is not None:
        planes = F.pad(planes, (0, -points.shape[1] % GROUP), value=padding)
    return planes.contiguous()
