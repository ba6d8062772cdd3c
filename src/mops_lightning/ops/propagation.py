"""From the sampled points back to all points: labels, colours, scores and features.

A map names the nearest sampled points of every point. Floats are averaged with inverse-distance
weights, as in PointNet++ (Qi et al., NeurIPS 2017); whole numbers are never averaged unless the
caller asks for it, so that a label stays a label.
"""

import warnings
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional as F

from mops_lightning.errors import UserError
from mops_lightning.filesystem import load_npz
from mops_lightning.ops.nearest import k_nearest, nearest
from mops_lightning.ops.points import as_tensor, cloud_sizes

CLOSE = 1e-8
"""Squared distance in the unit sphere below which a point has nearly all of the weight."""


MORE = 8
"""Additional points that a tree is asked for, among which ties are broken."""

ROUNDING = 1e-12
"""Relative error of squared distances, which are rounded differently in the tree."""

SIGNED = {
    torch.uint16: torch.int16,
    torch.uint32: torch.int32,
    torch.uint64: torch.int64,
}
"""Data types of the same size, for which torch has all operations."""

HALF = 2.0**32


class PropagationMap(NamedTuple):
    """The nearest sampled points of every point.

    Attributes:
        rows: ``(N, k)`` or ``(B, N, k)`` int64, rows of the sampled points, the nearest first; −1
            for points of a file without finite coordinates.
        weights: of the rows, floating point; their sum is 1.
        m: number of sampled points, of every cloud where rows are ``(B, N, k)``.
    """

    rows: Tensor
    weights: Tensor
    m: int


def propagation_map(
    points: Any, sampled: Any, k: int = 1, batch: Any = None, sampled_batch: Any = None
) -> PropagationMap:
    """Find the k nearest sampled points of every point, and their weights.

    The weights are proportional to 1/d², d the distance; a point at distance 0 gets all of it.

    Args:
        points: ``(N, C)``, ``(B, N, C)``, or ``(P, C)`` with ``batch``; a tensor or an array.
        sampled: their sample ``(m, C)``, ``(B, m, C)``, or ``(Q, C)`` with ``sampled_batch``.
        k: number of sampled points, at most as many as each cloud has.
        batch: ``(P,)`` the cloud of every point, ascending from 0, as in PyTorch Geometric.
        sampled_batch: ``(Q,)`` the cloud of every sampled point.

    Returns:
        Rows of ``sampled``; with ``batch`` they count through all clouds.

    Raises:
        UserError: an argument has a wrong shape or value.

    Examples:
        >>> import torch
        >>> from mops_lightning import propagation_map
        >>> line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
        >>> propagation_map(line, line[[0, 2]]).rows  # one cloud; of (B, N, 3) they are (B, N, k)
        tensor([[0],
                [0],
                [1]])
    """
    points, sampled = as_tensor("points", points), as_tensor("sampled", sampled)
    if (batch is None) != (sampled_batch is None):
        raise UserError("batch and sampled_batch belong together: give both or none.")
    ndim = 2 if batch is not None or points.ndim == 2 else 3
    for name, tensor in (("points", points), ("sampled", sampled)):
        if tensor.ndim != ndim or not tensor.is_floating_point():
            raise UserError(
                f"{name} must be floating point of {ndim} dimensions, got {tensor.dtype} of shape "
                f"{tuple(tensor.shape)}."
            )
    if batch is not None:
        sizes = cloud_sizes(len(points), as_tensor("batch", batch)).tolist()
        labels = as_tensor("sampled_batch", sampled_batch)
        numbers = cloud_sizes(len(sampled), labels, "sampled_batch").tolist()
        clouds, samples = points.split(sizes), sampled.split(numbers)
    elif ndim == 2:
        clouds, samples = (points,), (sampled,)
    else:
        clouds, samples = points.unbind(), sampled.unbind()
    if len(clouds) != len(samples) or not clouds:
        raise UserError(
            f"points and sampled must have as many clouds, got {len(clouds)} and {len(samples)}."
        )
    found = [_search(cloud, sample, k) for cloud, sample in zip(clouds, samples, strict=True)]
    rows, weights = zip(*found, strict=True)
    if ndim == 3:
        return PropagationMap(torch.stack(rows), torch.stack(weights), sampled.shape[1])
    begins = np.cumsum([0, *map(len, samples)])[:-1].tolist()
    shifted = [part + begin for part, begin in zip(rows, begins, strict=True)]
    return PropagationMap(torch.cat(shifted), torch.cat(weights), len(sampled))


def mapper(sampled: Any, k: int = 1) -> Callable[[Any], PropagationMap]:
    """Return ``propagation_map`` for the parts of one cloud; its tree is built only once.

    Args:
        sampled: ``(m, C)``, on the CPU.
        k: number of sampled points.
    """
    sampled = as_tensor("sampled", sampled)
    tree = cKDTree(sampled.double().numpy()) if k > 1 else None

    def map_part(points: Any) -> PropagationMap:
        rows, weights = _search(as_tensor("points", points), sampled, k, tree)
        return PropagationMap(rows, weights, len(sampled))

    return map_part


@torch.no_grad()
def _search(points: Tensor, sampled: Tensor, k: int, tree: Any = None) -> tuple[Tensor, Tensor]:
    """Return the k nearest rows ``(N, k)`` of one cloud, and their weights."""
    if points.shape[1] != sampled.shape[1]:
        raise UserError(
            f"points and sampled must have the same number of coordinates, got {points.shape[1]} "
            f"and {sampled.shape[1]}."
        )
    most = len(sampled)
    if not 1 <= k <= most:
        raise UserError(f"k must be from 1 to the number of sampled points, {most}, got {k}.")
    if not (bool(torch.isfinite(points).all()) and bool(torch.isfinite(sampled).all())):
        raise UserError("points and sampled must be finite, got NaN or infinity.")
    dtype = torch.promote_types(points.dtype, sampled.dtype)
    points, sampled = points.to(dtype), sampled.to(dtype)
    if k == 1:
        rows = nearest(points[None], sampled[None])[1][0, :, None]
        return rows, torch.ones_like(rows, dtype=torch.promote_types(dtype, torch.float32))
    if tree is None:
        tree = cKDTree(sampled.double().cpu().numpy())
    found = _nearest_in_tree(tree, points.double().cpu().numpy(), k)
    squared, rows = (torch.from_numpy(part).to(points.device) for part in found)
    # Relative to the nearest point, because 1/d² may be infinite.
    inverse = torch.where(squared[:, :1] > 0, squared[:, :1] / squared, (squared == 0).to(squared))
    weights = inverse / inverse.sum(1, keepdim=True)
    return rows, weights.to(torch.promote_types(dtype, torch.float32))


def _nearest_in_tree(
    tree: Any, points: NDArray[np.float64], k: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the squared distances and rows ``(N, k)`` of the nearest points of a tree.

    They are sorted by distance, and by row in case of ties. The tree itself takes any of the points
    at the same distance, so more points are asked for, and all where these are not enough.
    """
    asked = min(k + MORE, tree.n)
    rows = np.asarray(tree.query(points, k=asked)[1], np.int64).reshape(len(points), asked)
    squared, rows = _by_distance(tree, points, rows)
    if asked < tree.n:
        tied = np.flatnonzero(squared[:, -1] <= squared[:, k - 1] * (1 + ROUNDING))
        reach = np.sqrt(squared[tied, k - 1]) * (1 + ROUNDING)
        within = tree.query_ball_point(points[tied], reach)
        for place, candidates in zip(tied, within, strict=True):
            row = np.asarray(candidates, np.int64)[None]
            near, ordered = _by_distance(tree, points[place, None], row)
            squared[place, :k], rows[place, :k] = near[0, :k], ordered[0, :k]
    return squared[:, :k], rows[:, :k]


def _by_distance(
    tree: Any, points: NDArray[np.float64], rows: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return squared distances ``(N, n)`` and rows, by distance and by row in case of ties."""
    squared = np.square(tree.data[rows] - points[:, None]).sum(2)
    order = np.lexsort((rows, squared), axis=1)
    return np.take_along_axis(squared, order, 1), np.take_along_axis(rows, order, 1)


def propagate(values: Any, map: Any, mean: bool = False, fill: Any = None) -> Any:
    """Carry values of the sampled points to all points.

    With one sampled point per point, values are copied. With several, floats are averaged by the
    weights, and of whole numbers the one with the largest sum of weights is taken.

    Args:
        values: ``(m, ...)``, or ``(B, m, ...)`` for maps of ``(B, N, k)``: one row per sampled
            point, in the order of the sample; a tensor or an array.
        map: from ``propagation_map``, or the file that ``downsample --map`` writes.
        mean: average whole numbers too, such as colours, and round them.
        fill: value of the points of a file without finite coordinates.

    Packed colours are numbers to this function: ``mops-lightning propagate`` knows them by their
    name.

    Returns:
        ``(N, ...)`` or ``(B, N, ...)``, of the type and dtype of ``values``, on their device.
        Gradients flow to floating-point values.

    Raises:
        UserError: map and values do not fit, or ``fill`` is missing.

    Examples:
        >>> import torch
        >>> from mops_lightning import propagate, propagation_map
        >>> line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
        >>> propagate(torch.tensor([7, 8]), propagation_map(line, line[[0, 2]]))
        tensor([7, 7, 8])
    """
    if isinstance(map, str | PathLike):
        map = read_map(Path(map))
    if not isinstance(map, PropagationMap):
        raise UserError(f"map must be a PropagationMap or a file, got {type(map).__name__}.")
    numbers = as_tensor("values", values)
    rows, leading = _rows(map, numbers).to(numbers.device), map.rows.ndim - 1
    missing = rows[:, 0] < 0
    if fill is None and bool(missing.any()):
        raise UserError(
            f"map: {int(missing.sum())} points have no finite coordinates. Give their value, such "
            "as fill=0."
        )
    rows = rows.clamp_min(0)
    table = numbers.reshape(-1, *numbers.shape[leading:])
    weights = map.weights.to(numbers.device).reshape(rows.shape)
    if rows.shape[1] == 1:
        result = _signed(table)[rows[:, 0]].view(table.dtype)
    elif mean or table.is_floating_point():
        result = _mean(table, rows, weights)
    else:
        result = _vote(table, rows, weights)
    if bool(missing.any()):
        value = _fill_value(fill, table.dtype).to(table.device)
        _signed(result)[missing] = _signed(value)
    result = result.reshape(*map.rows.shape[:-1], *numbers.shape[leading:])
    return result if isinstance(values, Tensor) else result.numpy()


def interpolate(values: Tensor, points: Tensor, queries: Tensor, k: int = 3) -> Tensor:
    """Return values at other points: means of the nearest points' values, weighted by 1/d².

    The interpolation of PointNet++ (Qi et al., NeurIPS 2017). Unlike ``propagate``, it has
    gradients with respect to all three arguments.

    Args:
        values: ``(B, M, C)``, one row per point.
        points: ``(B, M, 3)``.
        queries: ``(B, N, 3)``, where to interpolate.
        k: number of nearest points; all if there are fewer.

    Returns:
        ``(B, N, C)``.
    """
    squared, rows = k_nearest(queries, points, min(k, points.shape[1]))
    weights = 1 / (squared + CLOSE)
    weights = weights / weights.sum(2, keepdim=True)
    clouds, m, channels = values.shape
    places = rows + torch.arange(clouds, device=rows.device)[:, None, None] * m
    # One sum per query, without the tensor of all neighbours' values.
    mean = F.embedding_bag(
        places.flatten(0, 1),
        values.flatten(0, 1),
        mode="sum",
        per_sample_weights=weights.flatten(0, 1).to(values),
    )
    return mean.view(clouds, -1, channels)


def _rows(map: PropagationMap, values: Tensor) -> Tensor:
    """Return the rows ``(T, k)`` of values whose clouds are one after the other; check both."""
    leading, clouds = map.rows.ndim - 1, map.rows.shape[:-2]
    if tuple(values.shape[:leading]) != (*clouds, map.m):
        raise UserError(
            f"values must have one row for each of {map.m} sampled points, shape "
            f"{(*clouds, map.m)}, got {tuple(values.shape)}."
        )
    rows = map.rows.long()
    if rows.numel() and not (int(rows.min()) >= -1 and int(rows.max()) < map.m):
        raise UserError(
            f"map: rows must be from -1 to {map.m - 1}, got {int(rows.min())} to {int(rows.max())}."
        )
    if clouds:
        rows = rows + map.m * torch.arange(clouds[0], device=rows.device)[:, None, None]
    return rows.reshape(-1, rows.shape[-1])


def _signed(numbers: Tensor) -> Tensor:
    """Return the same memory as signed integers, where torch lacks operations for unsigned ones."""
    return numbers.view(SIGNED.get(numbers.dtype, numbers.dtype))


def _fill_value(fill: Any, dtype: torch.dtype) -> Tensor:
    """Return the value of points without coordinates.

    Raises:
        UserError: the data type of the values cannot hold it.
    """
    kind = torch.empty(0, dtype=dtype).numpy().dtype if dtype != torch.bfloat16 else None
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wanted = np.asarray(fill)
            stored = wanted.astype(kind or np.float32)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"fill must be a number, got {fill!r}.") from None
    exact = stored.dtype.kind == "f" or np.array_equal(stored.astype(object), wanted.astype(object))
    if not exact:
        raise UserError(f"fill must be a number of the type {dtype}, got {fill!r}.")
    return torch.from_numpy(np.array(stored)).to(dtype)


def _mean(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Return weighted means, of the table's dtype."""
    if table.dtype in (torch.int64, torch.uint64):
        return _mean_of_64_bits(table, rows, weights)
    exact = table if table.is_floating_point() else table.double()
    weights = weights.to(torch.promote_types(exact.dtype, torch.float32))
    weights = weights.reshape(*weights.shape, *[1] * (table.ndim - 1))
    total = exact[rows[:, 0]] * weights[:, 0]
    for i in range(1, rows.shape[1]):
        total = total + exact[rows[:, i]] * weights[:, i]
    return (total if table.is_floating_point() else total.round()).to(table.dtype)


def _mean_of_64_bits(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Return rounded weighted means of whole numbers that float64 does not hold.

    The differences from the value with the largest weight are averaged, in two halves of 32 bits.
    The sum of value and difference may overflow on the way, and the result does not.
    """
    bits = _signed(table)
    high = (bits >> 32).double()
    if table.dtype == torch.uint64:
        high = torch.where(high < 0, high + HALF, high)
    low = (bits & 0xFFFFFFFF).double()
    base = rows.gather(1, weights.argmax(1, keepdim=True))[:, 0]
    weights = weights.double() / weights.double().sum(1, keepdim=True)
    weights = weights.reshape(*weights.shape, *[1] * (table.ndim - 1))
    difference = torch.zeros_like(high[base])
    for i in range(rows.shape[1]):
        row = rows[:, i]
        away = (high[row] - high[base]) * HALF + (low[row] - low[base])
        difference = difference + away * weights[:, i]
    difference = difference.round()
    upper = (difference / HALF).floor()
    lower = difference - upper * HALF
    return (bits[base] + (upper.long() << 32) + lower.long()).view(table.dtype)


def _vote(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Return, column by column, the value with the largest sum of weights; of equals the nearer."""
    bits = _signed(table)
    codes = bits.long().reshape(len(table), -1)[rows]  # (T, k, columns)
    votes = [
        ((codes == codes[:, i, None]) * weights[..., None]).sum(1) for i in range(rows.shape[1])
    ]
    winner = torch.stack(votes, 1).argmax(1, keepdim=True)
    chosen = codes.gather(1, winner).to(bits.dtype).reshape(-1, *table.shape[1:])
    return chosen.view(table.dtype)


def read_map(path: Path) -> PropagationMap:
    """Read the file that ``downsample --map`` writes.

    Raises:
        UserError: the file is missing, broken, or not a map.
    """
    if not path.is_file():
        raise UserError(f"map: no file {path}. Write it by downsample --map {path}.")
    arrays = load_npz(path)
    rows: Any = arrays.get("rows")
    m: Any = arrays.get("m")
    kinds = {array.dtype.kind for array in (rows, m) if array is not None}
    if rows is None or m is None or not kinds <= {"i", "u"} or not _sizes_fit(rows, m):
        raise UserError(
            f"{path} is no map: it must hold whole numbers, rows (N, k) and m of at least 1, got "
            f"{', '.join(arrays) or 'no arrays'}. Write it by downsample --map."
        )
    weights = arrays.get("weights", np.ones((len(rows), 1), np.float32))  # may lack for k = 1
    are_numbers = weights.dtype.kind in "fiu" and weights.shape == rows.shape
    if not are_numbers or not (np.isfinite(weights).all() and (weights >= 0).all()):
        raise UserError(f"{path}: weights must be finite, at least 0, and of shape {rows.shape}.")
    if weights.dtype.kind != "f":
        weights = weights.astype(np.float64)
    whole = as_tensor("rows", rows.astype(np.int64))
    return PropagationMap(whole, as_tensor("weights", weights), int(m))


def _sizes_fit(rows: NDArray[Any], m: NDArray[Any]) -> bool:
    return rows.ndim == 2 and rows.shape[1] > 0 and m.ndim == 0 and bool(m >= 1)
