"""Input clouds: arrays or tensors, one or many, of one or several sizes."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.points import as_tensor, cloud_sizes, gather_points
from mops_lightning.ops.weights import CURVATURE, check_positive, check_weight, curvature

Select = Callable[[Tensor, int, Tensor | None], tuple[Tensor, Tensor | None]]
"""``select(points, m, weight)`` maps ``(B, N, 3)``, with weights ``(B, N)`` above 0 or None, to
points ``(B, m, 3)`` and their rows ``(B, m)``, None for generated points."""

Weight = Tensor | str | None
"""Weights of at least 0, or ``"curvature"``."""

Sample = tuple[Tensor, Tensor | None]
"""Selected points in the clouds' own unit, and their rows, None for generated points: ``(m, 3)``
and ``(m,)`` of one cloud, ``(B, m, 3)`` and ``(B, m)`` of a batch."""


def select_points(
    select: Select, points: Any, m: int, batch: Any = None, weight: Any = None
) -> tuple[Any, Any]:
    """Select points of clouds in their own unit.

    Args:
        select: see ``Select``. The other arguments and the result are as in
            ``Sampler.downsample``.
        points: see there.
        m: see there.
        batch: see there.
        weight: see there.

    Raises:
        UserError: an argument has a wrong type, shape or value.
    """
    tensor = as_tensor("points", points)
    if not tensor.is_floating_point():
        conversion = "astype(float)" if isinstance(points, np.ndarray) else "float()"
        raise UserError(
            f"points must be floating point, got {tensor.dtype}. Try points.{conversion}."
        )
    if weight is not None and not isinstance(weight, str):
        weight = check_weight(weight, tuple(tensor.shape[:-1])).to(tensor.device)
    one = tensor.ndim == 2
    if tensor.ndim not in (2, 3) or tensor.shape[-1] != 3 or (batch is not None and not one):
        wanted = "(N, 3) or (B, N, 3)" if batch is None else "(P, 3) with batch"
        raise UserError(f"points must have shape {wanted}, got {tuple(tensor.shape)}.")
    if batch is not None:
        result = _flat(select, tensor, m, as_tensor("batch", batch), weight)
    elif one:
        alone = weight[None] if isinstance(weight, Tensor) else weight
        chosen, rows = _selected(select, tensor[None], m, alone)
        result = chosen[0], None if rows is None else rows[0]
    else:
        result = _selected(select, tensor, m, weight)
    if not isinstance(points, np.ndarray):
        return result
    return result[0].numpy(), None if result[1] is None else result[1].numpy()


def _flat(select: Select, points: Tensor, m: int, batch: Tensor, weight: Weight) -> Sample:
    """Select from clouds one after the other; rows count through all clouds."""
    counts = cloud_sizes(len(points), batch).tolist()
    if 0 in counts:
        raise UserError(f"batch: cloud {counts.index(0)} has no points. Number clouds from 0.")
    weights = weight.split(counts) if isinstance(weight, Tensor) else [weight] * len(counts)
    samples = _each(select, list(points.split(counts)), m, weights)
    starts = np.cumsum([0, *counts[:-1]]).tolist()
    chosen = torch.cat([sampled for sampled, _ in samples])
    parts = zip(samples, starts, strict=True)
    rows = [rows + start for (_, rows), start in parts if rows is not None]
    return chosen, torch.cat(rows) if len(rows) == len(samples) else None


def _each(select: Select, clouds: list[Tensor], m: int, weights: Sequence[Weight]) -> list[Sample]:
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
        tensors = [part for part in (weights[i] for i in members) if isinstance(part, Tensor)]
        weight = torch.stack(tensors) if tensors else weights[0]
        points, rows = _selected(select, torch.stack([clouds[i] for i in members]), m, weight)
        for place, i in enumerate(members):
            samples[i] = points[place], None if rows is None else rows[place]
    return [samples[i] for i in range(len(clouds))]


def _selected(select: Select, points: Tensor, m: int, weight: Weight) -> Sample:
    """Select from clouds of one size, in their own unit."""
    if points.shape[0] == 0 or points.shape[1] == 0:
        raise UserError(
            f"points must have at least one cloud and one point, got shape {tuple(points.shape)}."
        )
    if isinstance(weight, str):
        weight = _computed(weight, points)
    if weight is not None and not bool(weight.all()):
        return _without_zeros(select, points, m, weight)
    chosen, rows = select(points, m, weight)
    return chosen if rows is None else gather_points(points, rows), rows


def select_in_unit_sphere(select: Select, points: Tensor, m: int, weight: Tensor | None) -> Sample:
    """Move clouds into the unit sphere, as float32, select points, and map them back."""
    exact = points.double()
    centre = exact.mean(1, keepdim=True)
    centred = exact - centre
    x, y, z = centred.unbind(2)
    # Four times as fast as a norm along three columns.
    radius = (x * x + y * y + z * z).amax(1).sqrt()[:, None, None]
    radius = torch.where(radius > 0, radius, 1.0)
    chosen, rows = select(centred.div_(radius).float(), m, weight)
    return (chosen.double() * radius + centre).to(points.dtype), rows


def _computed(word: str, points: Tensor) -> Tensor:
    """Return the weights ``(B, N)`` that a word asks for."""
    if word != CURVATURE:
        raise UserError(f"weight must be {CURVATURE!r} or numbers, got {word!r:.99}.")
    parts = [torch.from_numpy(curvature(cloud.cpu().numpy())) for cloud in points.detach()]
    return torch.stack(parts).to(points.device)


def _without_zeros(select: Select, points: Tensor, m: int, weight: Tensor) -> Sample:
    """Select from the points of positive weight only."""
    chosen, rows = [], []
    for cloud, part in zip(points, weight, strict=True):
        kept = part.nonzero()[:, 0]
        check_positive(len(kept), m)
        sampled, places = _selected(select, cloud[kept][None], m, part[kept][None])
        assert places is not None  # generated points have no weights
        chosen.append(sampled[0])
        rows.append(kept[places[0]])
    return torch.stack(chosen), torch.stack(rows)
