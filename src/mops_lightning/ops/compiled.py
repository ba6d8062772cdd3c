"""Farthest points, nearest points and largest features on a CPU, by compiled loops.

The loops are in ``ops.kernels`` and ``ops.kernel_neighbours``. The first call of ``farthest``
compiles for 5 s, the first call of the others for 1 to 4 s, once per dtype; later processes read
the compiled form from a file. All functions return None where the torch form must be used: on other
devices, and for points that are not finite.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.ops import kernel_neighbours, kernels
from mops_lightning.ops.farthest import farthest_rows, rows_from_start
from mops_lightning.ops.keys import SeededOrder
from mops_lightning.ops.points import distance_dtype

NEAREST_LEAF = 256
"""Maximum number of points of a leaf of the tree."""

THREADS_MIN_WORK = 2**22
"""Minimum number of distances or comparisons in a batch, estimated, for using several threads."""

Array = NDArray[Any]


def farthest(
    points: Tensor,
    given: Tensor,
    counts: Tensor,
    m: int,
    factors: Tensor | None = None,
) -> Tensor | None:
    """Fill up rows of every cloud by farthest points; see ``ops.farthest.farthest_rows``."""
    if points.device.type != "cpu" or points.numel() == 0:
        return None
    if factors is None:
        factor_array = None
    else:
        factor_array = factors.numpy()
    rows = farthest_rows(
        points.detach().to(distance_dtype(points)).numpy(),
        given.numpy(),
        counts.numpy(),
        m,
        factor_array,
        threads=torch.get_num_threads(),
    )
    if rows is None:
        return None
    return torch.from_numpy(rows)


def farthest_from_start(
    points: Tensor,
    m: int,
    order: SeededOrder,
    start: int | str | None = None,
    weight: Tensor | None = None,
) -> Tensor | None:
    """Return farthest points of every cloud; see ``ops.farthest.rows_from_start``."""
    if points.device.type != "cpu" or points.numel() == 0:
        return None
    if weight is None:
        weight_array = None
    else:
        weight_array = weight.double().numpy()
    rows = rows_from_start(
        points.detach().to(distance_dtype(points)).numpy(),
        m,
        order,
        start,
        weight_array,
        torch.get_num_threads(),
    )
    if rows is None:
        return None
    return torch.from_numpy(rows)


def nearest(queries: Tensor, points: Tensor, k: int) -> Tensor | None:
    """Find the k nearest points for every query.

    Args:
        queries: ``(B, M, C)``.
        points: ``(B, N, C)``.
        k: number of neighbours, at most N.

    Returns:
        ``(B, M, k)`` int64, nearest first, the lowest row in case of ties.
    """
    if points.device.type != "cpu":
        return None
    if points.numel() == 0 or queries.numel() == 0:
        return None
    if k > 1:
        return _several_nearest(queries, points, k)
    clouds, n, channels = points.shape
    planes = _planes(points)
    flat = queries.detach().to(distance_dtype(points)).contiguous().flatten(1).numpy()
    scratch = np.empty((clouds, n), _integer(planes))
    one_each = zip(planes, flat, scratch, strict=True)
    work = NEAREST_LEAF * (n + queries.shape[1]) * clouds
    rows = _rows(lambda cloud: kernels.nearest(*cloud, channels, NEAREST_LEAF), one_each, work)
    if rows is None:
        return None
    return rows[..., None]


def _several_nearest(queries: Tensor, points: Tensor, k: int) -> Tensor | None:
    """Find the k > 1 nearest points; arguments and result as for ``nearest``."""
    clouds, m, channels = queries.shape
    dtype = distance_dtype(points)
    many = points.detach().to(dtype).contiguous().view(clouds, -1).numpy()
    few = queries.detach().to(dtype).contiguous().view(clouds, -1).numpy()
    rows = torch.empty(clouds, m, k, dtype=torch.int64, device="cpu")
    out = rows.view(clouds, -1).numpy()

    def search(part: slice) -> bool:
        some = out[part].reshape(-1, k)
        is_finite: bool = kernel_neighbours.neighbours(
            many[part].reshape(-1), few[part].reshape(-1), len(out[part]), channels, some
        )
        return is_finite

    are_finite = _in_threads(search, clouds, work=points.shape[1] * m * clouds)
    if not all(are_finite):
        return None
    return rows


def winners(features: Tensor, rows: Tensor) -> Tensor | None:
    """Find the row with the largest feature in every channel.

    Args:
        features: ``(B, N, C)``.
        rows: ``(B, M, k)`` int64, the rows to choose from.

    Returns:
        ``(B, M, C)`` int64, the first row in case of ties, or of a NaN.
    """
    if features.device.type != "cpu" or features.numel() == 0:
        return None
    if features.dtype.itemsize < 4:
        features = features.float()  # numba has no such numbers
    clouds, m, _ = rows.shape
    largest = torch.empty(clouds, m, features.shape[2], dtype=torch.int64, device="cpu")
    arrays = [part.detach().contiguous().numpy() for part in (features, rows, largest)]

    def search(part: slice) -> None:
        kernel_neighbours.winners(*(array[part] for array in arrays))

    _in_threads(search, clouds, work=rows.numel() * features.shape[2])
    return largest


def _in_threads(function: Callable[[slice], Any], clouds: int, work: int) -> list[Any]:
    """Call a function for parts of the clouds, in threads where that is faster."""
    workers = 1
    if work >= THREADS_MIN_WORK:
        workers = min(torch.get_num_threads(), clouds)
    if workers == 1:
        return [function(slice(0, clouds))]
    parts = np.array_split(np.arange(clouds), workers)
    slices = [slice(part[0], part[-1] + 1) for part in parts]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(function, slices))


def _planes(points: Tensor) -> Array:
    """Return a copy ``(B, C·N)``, one channel after the other, which may be overwritten."""
    values = points.detach().to(distance_dtype(points)).numpy()
    planes = np.array(values.transpose(0, 2, 1), order="C")
    return planes.reshape(len(values), -1)


def _integer(floats: Array) -> Any:
    """Return the integers of the same width."""
    if floats.dtype == np.float32:
        return np.int32
    return np.int64


def _rows(
    function: Callable[[tuple[Array, ...]], Array],
    clouds: Iterable[tuple[Array, ...]],
    work: int,
) -> Tensor | None:
    """Return the rows chosen from every cloud, computed in threads where that is faster."""
    workers = 1
    if work >= THREADS_MIN_WORK:
        workers = torch.get_num_threads()
    if workers == 1:
        rows = [function(cloud) for cloud in clouds]
    else:
        with ThreadPoolExecutor(workers) as pool:
            rows = list(pool.map(function, clouds))
    if not all(map(len, rows)):  # points that are not finite
        return None
    if len(rows) == 1:
        return torch.from_numpy(rows[0][None])
    return torch.from_numpy(np.stack(rows))
