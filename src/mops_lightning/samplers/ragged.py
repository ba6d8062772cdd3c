"""Input clouds: arrays or tensors, one or many, of one or several sizes."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mops_lightning.channels import NO_CHANNELS, PointChannels, coordinates
from mops_lightning.errors import UserError
from mops_lightning.ops.points import as_tensor, cloud_sizes, gather_points
from mops_lightning.ops.weights import CURVATURE, check_positive, check_weight, curvature

Select = Callable[[Tensor, int, Tensor | None], tuple[Tensor, Tensor | None]]
"""``select(points, m, weight)`` maps ``(B, N, 3 + C)``, with weights ``(B, N)`` above 0 or None, to
points ``(B, m, 3 + C)`` and their rows ``(B, m)``, None for generated points."""

Weight = Tensor | str | None
"""Weights of at least 0, or ``"curvature"``."""

Sample = tuple[Tensor, Tensor | None]
"""Selected points in the clouds' own unit, and their rows, None for generated points:
``(m, 3 + C)`` and ``(m,)`` of one cloud, ``(B, m, 3 + C)`` and ``(B, m)`` of a batch."""


class Method(NamedTuple):
    """What selects points.

    Attributes:
        select: see ``Select``.
        channels: that it takes.
        any_channels: whether it takes points with any channels, which it does not see.
    """

    select: Select
    channels: PointChannels = NO_CHANNELS
    any_channels: bool = True


def select_points(
    method: Method,
    points: Any,
    m: int,
    batch: Any = None,
    weight: Any = None,
) -> tuple[Any, Any]:
    """Select points of clouds in their own unit.

    Args:
        method: what selects. The other arguments and the result are as in ``Sampler.downsample``.
        points: see there.
        m: see there.
        batch: see there.
        weight: see there.

    Raises:
        UserError: an argument has a wrong type, shape or value.
    """
    tensor = as_tensor("points", points)
    is_array = isinstance(points, np.ndarray)
    if not tensor.is_floating_point():
        conversion = "float()"
        if is_array:
            conversion = "astype(float)"
        raise UserError(
            f"points must be floating point, got {tensor.dtype}. Try points.{conversion}."
        )
    if weight is not None and not isinstance(weight, str):
        shape = tuple(tensor.shape[:-1])
        weight = check_weight(weight, shape).to(tensor.device)
    _check_shape(tensor, method, batch is not None)
    if batch is not None:
        cloud_of_point = as_tensor("batch", batch)
        chosen, rows = _flat(method, tensor, m, cloud_of_point, weight)
    elif tensor.ndim == 2:
        chosen, rows = _one(method, tensor, m, weight)
    else:
        chosen, rows = _selected(method, tensor, m, weight)
    if not is_array:
        return chosen, rows
    if rows is None:
        return chosen.numpy(), None
    return chosen.numpy(), rows.numpy()


def _one(method: Method, points: Tensor, m: int, weight: Weight) -> Sample:
    """Select from one cloud."""
    if isinstance(weight, Tensor):
        weight = weight[None]
    chosen, rows = _selected(method, points[None], m, weight)
    return _first(chosen, rows)


def _first(chosen: Tensor, rows: Tensor | None, cloud: int = 0) -> Sample:
    """Return the sample of one cloud of a batch."""
    if rows is None:
        return chosen[cloud], None
    return chosen[cloud], rows[cloud]


def _check_shape(points: Tensor, method: Method, is_flat: bool) -> None:
    """Refuse points without the columns of a method, and channels that are not numbers."""
    channels = method.channels
    least = 3 + len(channels)
    width = points.shape[-1]
    wanted = f"(N, {least}) or (B, N, {least})"
    has_dimensions = points.ndim in (2, 3)
    if is_flat:
        wanted = f"(P, {least}) with batch"
        has_dimensions = points.ndim == 2
    is_wide_enough = width == least or (width > least and method.any_channels)
    if not has_dimensions or not is_wide_enough:
        of_channels = ""
        if channels:
            names = ", ".join(channels.names)
            of_channels = f" with columns x, y, z, {names}"
        shape = tuple(points.shape)
        raise UserError(f"points must have shape {wanted}{of_channels}, got {shape}.")
    channels.check_known(points[..., 3:], "points")


def _flat(method: Method, points: Tensor, m: int, batch: Tensor, weight: Weight) -> Sample:
    """Select from clouds one after the other; rows count through all clouds."""
    counts = cloud_sizes(len(points), batch).tolist()
    if 0 in counts:
        empty = counts.index(0)
        raise UserError(f"batch: cloud {empty} has no points. Number clouds from 0.")
    weights: Sequence[Weight] = [weight] * len(counts)
    if isinstance(weight, Tensor):
        weights = weight.split(counts)
    clouds = list(points.split(counts))
    samples = _each(method, clouds, m, weights)
    chosen = torch.cat([points_of_cloud for points_of_cloud, _ in samples])
    all_rows = []
    start = 0
    for count, (_, rows) in zip(counts, samples, strict=True):
        if rows is None:
            return chosen, None
        all_rows.append(rows + start)
        start += count
    return chosen, torch.cat(all_rows)


def _each(method: Method, clouds: list[Tensor], m: int, weights: Sequence[Weight]) -> list[Sample]:
    """Select from every cloud; clouds of one size are processed together."""
    if not clouds:
        raise UserError("points must have at least one cloud.")
    samples: dict[int, Sample] = {}
    members_of_size: dict[int, list[int]] = defaultdict(list)
    for number, cloud in enumerate(clouds):
        members_of_size[len(cloud)].append(number)
    for size, members in sorted(members_of_size.items()):
        if size < m:
            everything = torch.arange(size, device=clouds[0].device)
            for number in members:
                samples[number] = clouds[number], everything
            continue
        points = torch.stack([clouds[number] for number in members])
        weight = _together([weights[number] for number in members])
        chosen, rows = _selected(method, points, m, weight)
        for place, number in enumerate(members):
            samples[number] = _first(chosen, rows, place)
    return [samples[number] for number in range(len(clouds))]


def _together(weights: Sequence[Weight]) -> Weight:
    """Return the weights of clouds as one batch; a word or None is the same for all."""
    tensors = [weight for weight in weights if isinstance(weight, Tensor)]
    if tensors:
        return torch.stack(tensors)
    return weights[0]


def _selected(method: Method, points: Tensor, m: int, weight: Weight) -> Sample:
    """Select from clouds of one size, in their own unit."""
    clouds, number = points.shape[:2]
    if clouds == 0 or number == 0:
        shape = tuple(points.shape)
        raise UserError(f"points must have at least one cloud and one point, got shape {shape}.")
    if isinstance(weight, str):
        weight = _computed(weight, points)
    if weight is not None and not bool(weight.all()):
        return _without_zeros(method, points, m, weight)
    chosen, rows = method.select(points, m, weight)
    if rows is None:
        return chosen, None
    return gather_points(points, rows), rows


def select_in_unit_sphere(
    select: Select,
    channels: PointChannels,
    points: Tensor,
    m: int,
    weight: Tensor | None,
) -> Sample:
    """Move clouds into the unit sphere, as float32, select points, and map them back.

    Args:
        select: gets points with scaled channels.
        channels: that it gets.
        points: ``(B, N, 3 + C)``, channels in the units of files.
        m: number of points.
        weight: ``(B, N)`` above 0, or None.
    """
    exact = coordinates(points).double()
    centre = exact.mean(1, keepdim=True)
    centred = exact - centre
    x, y, z = centred.unbind(2)
    # Four times as fast as a norm along three columns.
    squares = x * x + y * y + z * z
    radius = squares.amax(1).sqrt()[:, None, None]
    radius = torch.where(radius > 0, radius, 1.0)
    seen = centred.div_(radius).float()
    if channels:
        scaled = channels.scaled(points[..., 3:].double()).float()
        seen = torch.cat([seen, scaled], 2)
    chosen, rows = select(seen, m, weight)
    restored = coordinates(chosen).double() * radius + centre
    if channels:
        values = channels.restored(chosen[..., 3:].double())
        restored = torch.cat([restored, values], 2)
    return restored.to(points.dtype), rows


def _computed(word: str, points: Tensor) -> Tensor:
    """Return the weights ``(B, N)`` that a word asks for."""
    if word != CURVATURE:
        raise UserError(f"weight must be {CURVATURE!r} or numbers, got {word!r:.99}.")
    weights = []
    for cloud in points.detach():
        places = coordinates(cloud).cpu().numpy()
        weights.append(torch.from_numpy(curvature(places)))
    return torch.stack(weights).to(points.device)


def _without_zeros(method: Method, points: Tensor, m: int, weight: Tensor) -> Sample:
    """Select from the points of positive weight only."""
    all_chosen = []
    all_rows = []
    for cloud, weight_of_cloud in zip(points, weight, strict=True):
        heavy = weight_of_cloud.nonzero()[:, 0]
        check_positive(len(heavy), m)
        heavy_points = cloud[heavy]
        heavy_weight = weight_of_cloud[heavy]
        chosen, rows = _selected(method, heavy_points[None], m, heavy_weight[None])
        assert rows is not None  # generated points have no weights
        all_chosen.append(chosen[0])
        all_rows.append(heavy[rows[0]])
    return torch.stack(all_chosen), torch.stack(all_rows)
