"""Gathering, normalisation, memory layout and extremes of batched point clouds."""

import torch
from torch import Tensor
from torch.nn import functional as F

GROUP = 32
"""Number of consecutive values that ``blocked_argextreme`` reduces together."""

PLAIN_MAX_VALUES = 8192
"""Up to this number of values, torch's own argmax and argmin are faster."""


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


def blocked_argextreme(values: Tensor, largest: bool) -> Tensor:
    """Return ``values.argmax(1, keepdim=True)`` or ``values.argmin(1, keepdim=True)``.

    On a CPU, torch vectorises ``amax`` but not ``argmax``. This function therefore reduces groups
    of values first and searches for positions only among the groups and in the winning group.

    Args:
        values: ``(rows, L)``, L a multiple of ``GROUP``.
        largest: True for the maximum, False for the minimum.

    Returns:
        ``(rows, 1)`` int64; the lowest position in case of ties.
    """
    if values.numel() <= PLAIN_MAX_VALUES:
        return values.argmax(1, keepdim=True) if largest else values.argmin(1, keepdim=True)
    groups = values.view(len(values), -1, GROUP)
    extremes = groups.amax(2) if largest else groups.amin(2)
    group = extremes.argmax(1, keepdim=True) if largest else extremes.argmin(1, keepdim=True)
    winners = groups.gather(1, group[..., None].expand(-1, 1, GROUP))
    offset = winners.argmax(2) if largest else winners.argmin(2)
    return offset.add_(group, alpha=GROUP)
