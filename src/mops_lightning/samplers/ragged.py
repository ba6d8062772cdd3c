"""Input clouds: arrays or tensors, one or many, of one or several sizes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.points import as_tensor, cloud_sizes, gather_points

Select = Callable[[Tensor, int], tuple[Tensor, Tensor | None]]
"""``select(points, m)`` maps ``(B, N, 3)`` float32 in the unit sphere to points ``(B, m, 3)`` and
their rows ``(B, m)``, None for generated points."""


Sample = tuple[Tensor, Tensor | None]
"""Selected points in the clouds' own unit, and their rows, None for generated points: ``(m, 3)``
and ``(m,)`` of one cloud, ``(B, m, 3)`` and ``(B, m)`` of a batch."""


def select_points(select: Select, points: Any, m: int, batch: Any = None) -> tuple[Any, Any]:
    """Move clouds into the unit sphere, select points, and map them back.

    Args:
        select: see ``Select``. The other arguments and the result are as in
            ``Sampler.downsample``.
        points: see there.
        m: see there.
        batch: see there.

    Raises:
        UserError: an argument has a wrong type, shape or value.
    """
    tensor = as_tensor("points", points)
    if not tensor.is_floating_point():
        raise UserError(f"points must be floating point, got {tensor.dtype}. Try points.float().")
    if batch is not None:
        _check_shape(tensor, 2, "(P, 3) with batch")
        result = _flat(select, tensor, m, as_tensor("batch", batch))
    elif tensor.ndim == 2:
        _check_shape(tensor, 2, "(N, 3) or (B, N, 3)")
        chosen, rows = _selected(select, tensor[None], m)
        result = chosen[0], None if rows is None else rows[0]
    else:
        _check_shape(tensor, 3, "(N, 3) or (B, N, 3)")
        result = _selected(select, tensor, m)
    if not isinstance(points, np.ndarray):
        return result
    return result[0].numpy(), None if result[1] is None else result[1].numpy()


def _check_shape(points: Tensor, ndim: int, wanted: str) -> None:
    if points.ndim != ndim or points.shape[-1] != 3:
        raise UserError(f"points must have shape {wanted}, got {tuple(points.shape)}.")


def _flat(select: Select, points: Tensor, m: int, batch: Tensor) -> Sample:
    """Select from clouds one after the other; rows count through all clouds."""
    counts = cloud_sizes(len(points), batch).tolist()
    if 0 in counts:
        raise UserError(f"batch: cloud {counts.index(0)} has no points. Number clouds from 0.")
    samples = _each(select, list(points.split(counts)), m)
    starts = np.cumsum([0, *counts[:-1]]).tolist()
    chosen = torch.cat([sampled for sampled, _ in samples])
    parts = zip(samples, starts, strict=True)
    rows = [rows + start for (_, rows), start in parts if rows is not None]
    return chosen, torch.cat(rows) if len(rows) == len(samples) else None


def _each(select: Select, clouds: list[Tensor], m: int) -> list[Sample]:
    """Select from every cloud; clouds of one size are processed together."""
    if not clouds:
        raise UserError("points must have at least one cloud.")
    samples: dict[int, Sample] = {}
    for size in sorted({len(cloud) for cloud in clouds}):
        members = [i for i, cloud in enumerate(clouds) if len(cloud) == size]
        if size < m:
            everything = torch.arange(size, device=clouds[0].device)
            samples |= {i: (clouds[i], everything) for i in members}
            continue
        points, rows = _selected(select, torch.stack([clouds[i] for i in members]), m)
        for place, i in enumerate(members):
            samples[i] = points[place], None if rows is None else rows[place]
    return [samples[i] for i in range(len(clouds))]


def _selected(select: Select, points: Tensor, m: int) -> Sample:
    """Select from clouds of one size, in their own unit."""
    if points.shape[0] == 0 or points.shape[1] == 0:
        raise UserError(
            f"points must have at least one cloud and one point, got shape {tuple(points.shape)}."
        )
    exact = points.double()
    centre = exact.mean(1, keepdim=True)
    radius = torch.linalg.vector_norm(exact - centre, dim=2, keepdim=True).amax(1, keepdim=True)
    radius = torch.where(radius > 0, radius, 1.0)
    chosen, rows = select(((exact - centre) / radius).float(), m)
    if rows is not None:
        return gather_points(points, rows), rows
    return (chosen.double() * radius + centre).to(points.dtype), None
