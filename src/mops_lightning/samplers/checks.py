"""Checks of the clouds that samplers get."""

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.keys import are_finite


def check_points(
    points: Tensor,
    at_least: int = 1,
    finite: bool = True,
    channels: int | None = 0,
) -> None:
    """Check that an argument is a batch of clouds with enough points.

    Args:
        points: must be ``(B, N, 3 + channels)``, floating point and finite.
        at_least: smallest N allowed.
        finite: whether to check for NaN and infinity. Training on a GPU relies on the check in
            data loading.
        channels: number of channels beside x, y and z; None: any number.

    Raises:
        UserError: the argument is invalid.
    """
    if not isinstance(points, Tensor):
        raise UserError(f"points must be a torch.Tensor, got {type(points).__name__}.")
    shape = tuple(points.shape)
    width = 3 + (channels or 0)
    has_columns = points.ndim == 3 and points.shape[-1] >= width
    has_too_many = channels is not None and points.shape[-1] > width
    if not has_columns or has_too_many:
        wanted = f"(B, N, {width})"
        if channels:
            wanted += f", {channels} of them channels beside x, y and z"
        raise UserError(f"points must have shape {wanted}, got {shape}.")
    if not points.is_floating_point():
        raise UserError(f"points must be floating point, got {points.dtype}.")
    clouds, number = shape[:2]
    if clouds == 0 or number == 0:
        raise UserError(f"points must have at least one cloud and one point, got shape {shape}.")
    if number < at_least:
        raise UserError(f"m must be at most the number of points N={number}, got m={at_least}.")
    if finite and not _are_finite(points):
        raise UserError("points must be finite, got NaN or infinity.")


def _are_finite(points: Tensor) -> bool:
    if points.is_cpu and points.dtype in (torch.float32, torch.float64):
        return are_finite(points.detach().numpy())
    return bool(torch.isfinite(points).all())


def check_dtype(points: Tensor, weights: torch.dtype) -> None:
    """Check that points have the dtype of a sampler's weights.

    Raises:
        UserError: they have another one.
    """
    if points.dtype != weights:
        raise UserError(f"points must be {weights} like the sampler's weights, got {points.dtype}.")
