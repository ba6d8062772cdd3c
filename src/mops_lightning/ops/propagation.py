"""From the sampled points back to all points: labels, colours, scores and features.

A map names the nearest sampled points of every point. Floats are averaged with inverse-distance
weights, as in PointNet++ (Qi et al., NeurIPS 2017); whole numbers are never averaged unless the
caller asks for it, so that a label stays a label.
"""

import warnings
from collections.abc import Callable, Mapping
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
    points: Any,
    sampled: Any,
    k: int = 1,
    batch: Any = None,
    sampled_batch: Any = None,
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
    points = as_tensor("points", points)
    sampled = as_tensor("sampled", sampled)
    has_batch = batch is not None
    has_sampled_batch = sampled_batch is not None
    if has_batch != has_sampled_batch:
        raise UserError("batch and sampled_batch belong together: give both or none.")
    is_flat = has_batch or points.ndim == 2
    ndim = 3
    if is_flat:
        ndim = 2
    _check_kind("points", points, ndim)
    _check_kind("sampled", sampled, ndim)
    clouds = _split_clouds("batch", points, batch)
    samples = _split_clouds("sampled_batch", sampled, sampled_batch)
    if len(clouds) != len(samples) or not clouds:
        raise UserError(
            f"points and sampled must have as many clouds, got {len(clouds)} and {len(samples)}."
        )
    pairs = zip(clouds, samples, strict=True)
    near = [_search(cloud, sample, k) for cloud, sample in pairs]
    weights = [weights_of_cloud for _, weights_of_cloud in near]
    if not is_flat:
        rows = torch.stack([rows_in_sample for rows_in_sample, _ in near])
        return PropagationMap(rows, torch.stack(weights), sampled.shape[1])
    starts = _starts_of([len(sample) for sample in samples])
    all_rows = [rows + start for (rows, _), start in zip(near, starts, strict=True)]
    return PropagationMap(torch.cat(all_rows), torch.cat(weights), len(sampled))


def _starts_of(sizes: list[int]) -> list[int]:
    """Return the row at which every cloud begins in one tensor of all clouds."""
    starts = []
    start = 0
    for size in sizes:
        starts.append(start)
        start += size
    return starts


def _check_kind(name: str, points: Tensor, ndim: int) -> None:
    if points.ndim != ndim or not points.is_floating_point():
        shape = tuple(points.shape)
        raise UserError(
            f"{name} must be floating point of {ndim} dimensions, got {points.dtype} of shape "
            f"{shape}."
        )


def _split_clouds(name: str, points: Tensor, batch: Any) -> tuple[Tensor, ...]:
    """Return the clouds of ``(P, C)`` with a batch, of ``(N, C)``, or of ``(B, N, C)``."""
    if batch is not None:
        sizes = cloud_sizes(len(points), as_tensor(name, batch), name)
        return points.split(sizes.tolist())
    if points.ndim == 2:
        return (points,)
    return points.unbind()


def mapper(sampled: Any, k: int = 1) -> Callable[[Any], PropagationMap]:
    """Return ``propagation_map`` for the parts of one cloud; its tree is built only once.

    Args:
        sampled: ``(m, C)``, on the CPU.
        k: number of sampled points.
    """
    sampled = as_tensor("sampled", sampled)
    tree = None
    if k > 1:
        tree = cKDTree(sampled.double().numpy())

    def map_part(points: Any) -> PropagationMap:
        part = as_tensor("points", points)
        rows, weights = _search(part, sampled, k, tree)
        return PropagationMap(rows, weights, len(sampled))

    return map_part


@torch.no_grad()
def _search(points: Tensor, sampled: Tensor, k: int, tree: Any = None) -> tuple[Tensor, Tensor]:
    """Return the k nearest rows ``(N, k)`` of one cloud, and their weights."""
    _check_search(points, sampled, k)
    dtype = torch.promote_types(points.dtype, sampled.dtype)
    dtype_of_weights = torch.promote_types(dtype, torch.float32)
    if k == 1:
        dense = points.to(dtype)
        sparse = sampled.to(dtype)
        _, nearest_rows = nearest(dense[None], sparse[None])
        rows = nearest_rows[0, :, None]
        return rows, torch.ones_like(rows, dtype=dtype_of_weights)
    if tree is None:
        tree = cKDTree(sampled.double().cpu().numpy())
    coordinates = points.double().cpu().numpy()
    squared_array, row_array = _nearest_in_tree(tree, coordinates, k)
    squared = torch.from_numpy(squared_array).to(points.device)
    rows = torch.from_numpy(row_array).to(points.device)
    # Relative to the nearest point, because 1/d² may be infinite.
    nearest_squared = squared[:, :1]
    is_at_point = (squared == 0).to(squared)
    inverse = torch.where(nearest_squared > 0, nearest_squared / squared, is_at_point)
    weights = inverse / inverse.sum(1, keepdim=True)
    return rows, weights.to(dtype_of_weights)


def _check_search(points: Tensor, sampled: Tensor, k: int) -> None:
    channels = points.shape[1]
    sampled_channels = sampled.shape[1]
    if channels != sampled_channels:
        raise UserError(
            f"points and sampled must have the same number of coordinates, got {channels} "
            f"and {sampled_channels}."
        )
    most = len(sampled)
    if not 1 <= k <= most:
        raise UserError(f"k must be from 1 to the number of sampled points, {most}, got {k}.")
    are_finite = bool(torch.isfinite(points).all())
    are_sampled_finite = bool(torch.isfinite(sampled).all())
    if not (are_finite and are_sampled_finite):
        raise UserError("points and sampled must be finite, got NaN or infinity.")


def _nearest_in_tree(
    tree: Any, points: NDArray[np.float64], k: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the squared distances and rows ``(N, k)`` of the nearest points of a tree.

    They are sorted by distance, and by row in case of ties. The tree itself takes any of the points
    at the same distance, so more points are asked for, and all where these are not enough.
    """
    asked = min(k + MORE, tree.n)
    _, rows_in_tree = tree.query(points, k=asked)
    rows = np.asarray(rows_in_tree, np.int64)
    rows = rows.reshape(len(points), asked)
    squared, rows = _by_distance(tree, points, rows)
    if asked < tree.n:
        farthest = squared[:, k - 1]
        last = squared[:, -1]
        tied = np.flatnonzero(last <= farthest * (1 + ROUNDING))
        reach = np.sqrt(farthest[tied]) * (1 + ROUNDING)
        within = tree.query_ball_point(points[tied], reach)
        for number, candidates in zip(tied, within, strict=True):
            point = points[number, None]
            rows_within = np.asarray(candidates, np.int64)
            near_squared, near_rows = _by_distance(tree, point, rows_within[None])
            squared[number, :k] = near_squared[0, :k]
            rows[number, :k] = near_rows[0, :k]
    return squared[:, :k], rows[:, :k]


def _by_distance(
    tree: Any, points: NDArray[np.float64], rows: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return squared distances ``(N, n)`` and rows, by distance and by row in case of ties."""
    apart = tree.data[rows] - points[:, None]
    squared = np.square(apart).sum(2)
    order = np.lexsort((rows, squared), axis=1)
    ordered = np.take_along_axis(squared, order, 1)
    return ordered, np.take_along_axis(rows, order, 1)


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
    rows = _rows(map, numbers).to(numbers.device)
    is_missing = rows[:, 0] < 0
    has_missing = bool(is_missing.any())
    if fill is None and has_missing:
        raise UserError(
            f"map: {int(is_missing.sum())} points have no finite coordinates. Give their value, "
            "such as fill=0."
        )
    rows = rows.clamp_min(0)
    shape_of_clouds = map.rows.shape[:-1]
    shape_of_value = numbers.shape[map.rows.ndim - 1 :]
    table = numbers.reshape(-1, *shape_of_value)
    weights = map.weights.to(numbers.device).reshape(rows.shape)
    result = _of_neighbours(table, rows, weights, mean)
    if has_missing:
        value = _fill_value(fill, table.dtype).to(table.device)
        _signed(result)[is_missing] = _signed(value)
    result = result.reshape(*shape_of_clouds, *shape_of_value)
    if isinstance(values, Tensor):
        return result
    return result.numpy()


def _of_neighbours(table: Tensor, rows: Tensor, weights: Tensor, mean: bool) -> Tensor:
    """Return the value, the mean or the vote of every point's neighbours."""
    if rows.shape[1] == 1:
        nearest_rows = rows[:, 0]
        return _signed(table)[nearest_rows].view(table.dtype)
    if mean or table.is_floating_point():
        return _mean(table, rows, weights)
    return _vote(table, rows, weights)


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
    clouds, m, channels = values.shape
    neighbours = min(k, points.shape[1])
    squared, rows = k_nearest(queries, points, neighbours)
    weights = 1 / (squared + CLOSE)
    weights = weights / weights.sum(2, keepdim=True)
    starts = torch.arange(clouds, device=rows.device) * m
    rows_of_all = rows + starts[:, None, None]
    # One sum per query, without the tensor of all neighbours' values.
    mean = F.embedding_bag(
        rows_of_all.flatten(0, 1),
        values.flatten(0, 1),
        mode="sum",
        per_sample_weights=weights.flatten(0, 1).to(values),
    )
    return mean.view(clouds, -1, channels)


def _rows(map: PropagationMap, values: Tensor) -> Tensor:
    """Return the rows ``(T, k)`` of values whose clouds are one after the other; check both."""
    clouds = map.rows.shape[:-2]
    wanted = (*clouds, map.m)
    given = tuple(values.shape)
    if given[: len(wanted)] != wanted:
        raise UserError(
            f"values must have one row for each of {map.m} sampled points, shape "
            f"{wanted}, got {given}."
        )
    rows = map.rows.long()
    if rows.numel():
        least = int(rows.min())
        most = int(rows.max())
        last = map.m - 1
        if least < -1 or most > last:
            raise UserError(f"map: rows must be from -1 to {last}, got {least} to {most}.")
    if clouds:
        numbers = torch.arange(clouds[0], device=rows.device)
        starts = map.m * numbers
        rows = rows + starts[:, None, None]
    return rows.reshape(-1, rows.shape[-1])


def _signed(numbers: Tensor) -> Tensor:
    """Return the same memory as signed integers, where torch lacks operations for unsigned ones."""
    return numbers.view(SIGNED.get(numbers.dtype, numbers.dtype))


def _fill_value(fill: Any, dtype: torch.dtype) -> Tensor:
    """Return the value of points without coordinates.

    Raises:
        UserError: the data type of the values cannot hold it.
    """
    kind = np.dtype(np.float32)  # numpy has no bfloat16
    if dtype != torch.bfloat16:
        kind = torch.empty(0, dtype=dtype).numpy().dtype
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wanted = np.asarray(fill)
            stored = wanted.astype(kind)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"fill must be a number, got {fill!r}.") from None
    is_whole = stored.dtype.kind != "f"
    is_exact = np.array_equal(stored.astype(object), wanted.astype(object))
    if is_whole and not is_exact:
        raise UserError(f"fill must be a number of the type {dtype}, got {fill!r}.")
    return torch.from_numpy(np.array(stored)).to(dtype)


def _mean(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Return weighted means, of the table's dtype."""
    if table.dtype in (torch.int64, torch.uint64):
        return _mean_of_64_bits(table, rows, weights)
    is_whole = not table.is_floating_point()
    numbers = table
    if is_whole:
        numbers = table.double()
    weights = weights.to(torch.promote_types(numbers.dtype, torch.float32))
    weights = _for_values(weights, table)
    total = numbers[rows[:, 0]] * weights[:, 0]
    for neighbour in range(1, rows.shape[1]):
        values = numbers[rows[:, neighbour]]
        total = total + values * weights[:, neighbour]
    if is_whole:
        total = total.round()
    return total.to(table.dtype)


def _for_values(weights: Tensor, table: Tensor) -> Tensor:
    """Return weights ``(T, k)`` with as many dimensions as the values of ``(T, k)`` rows have."""
    dimensions = [1] * (table.ndim - 1)
    return weights.reshape(*weights.shape, *dimensions)


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
    heaviest = weights.argmax(1, keepdim=True)
    base = rows.gather(1, heaviest)[:, 0]
    weights = weights.double()
    weights = weights / weights.sum(1, keepdim=True)
    weights = _for_values(weights, table)
    base_high = high[base]
    base_low = low[base]
    difference = torch.zeros_like(base_high)
    for neighbour in range(rows.shape[1]):
        row = rows[:, neighbour]
        high_away = (high[row] - base_high) * HALF
        low_away = low[row] - base_low
        away = high_away + low_away
        difference = difference + away * weights[:, neighbour]
    difference = difference.round()
    upper = (difference / HALF).floor()
    lower = difference - upper * HALF
    upper_bits = upper.long() << 32
    mean = bits[base] + upper_bits + lower.long()
    return mean.view(table.dtype)


def _vote(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Return, column by column, the value with the largest sum of weights; of equals the nearer."""
    bits = _signed(table)
    codes_of_rows = bits.long().reshape(len(table), -1)
    codes = codes_of_rows[rows]  # (T, k, columns)
    votes = []
    for neighbour in range(rows.shape[1]):
        is_same = codes == codes[:, neighbour, None]
        weight_of_same = is_same * weights[..., None]
        votes.append(weight_of_same.sum(1))
    winner = torch.stack(votes, 1).argmax(1, keepdim=True)
    winning_codes = codes.gather(1, winner).to(bits.dtype)
    values = winning_codes.reshape(-1, *table.shape[1:])
    return values.view(table.dtype)


def read_map(path: Path) -> PropagationMap:
    """Read the file that ``downsample --map`` writes.

    Raises:
        UserError: the file is missing, broken, or not a map.
    """
    if not path.is_file():
        raise UserError(f"map: no file {path}. Write it by downsample --map {path}.")
    arrays = load_npz(path)
    if not _is_map(arrays):
        names = ", ".join(arrays) or "no arrays"
        raise UserError(
            f"{path} is no map: it must hold whole numbers, rows (N, k) and m of at least 1, got "
            f"{names}. Write it by downsample --map."
        )
    rows = arrays["rows"]
    equal_weights = np.ones((len(rows), 1), np.float32)
    weights = arrays.get("weights", equal_weights)  # may lack for k = 1
    if not _are_weights(weights, rows.shape):
        raise UserError(f"{path}: weights must be finite, at least 0, and of shape {rows.shape}.")
    if weights.dtype.kind != "f":
        weights = weights.astype(np.float64)
    return PropagationMap(
        rows=as_tensor("rows", rows.astype(np.int64)),
        weights=as_tensor("weights", weights),
        m=int(arrays["m"]),
    )


def _is_map(arrays: Mapping[str, NDArray[Any]]) -> bool:
    if "rows" not in arrays or "m" not in arrays:
        return False
    rows = arrays["rows"]
    m = arrays["m"]
    if rows.dtype.kind not in "iu" or m.dtype.kind not in "iu":
        return False
    has_rows = rows.ndim == 2 and rows.shape[1] > 0
    return has_rows and m.ndim == 0 and bool(m >= 1)


def _are_weights(weights: NDArray[Any], shape: tuple[int, ...]) -> bool:
    if weights.dtype.kind not in "fiu" or weights.shape != shape:
        return False
    are_finite = np.isfinite(weights).all()
    return bool(are_finite and (weights >= 0).all())
