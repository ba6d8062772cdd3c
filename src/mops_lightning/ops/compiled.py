"""Farthest and nearest points on a CPU by compiled loops, where numba is installed.

The rows are the same as those of the plain forms, bit for bit; only the time differs. All functions
return None where the plain form must be used: on other devices, without numba, and for points that
are not finite.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.ops.fps_cpu import sum_of_squares_
from mops_lightning.ops.points import distance_dtype

FARTHEST_LEAF, NEAREST_LEAF = 1024, 256
"""Maximum number of points of a leaf of the tree: more leaves exclude more points, larger ones
take less time per point."""

THREADS_MIN_WORK = 2**22
"""Minimum number of distances in a batch, estimated, for using several threads."""

Array = NDArray[Any]


def kernels() -> ModuleType | None:
    """Return the compiled functions, or None where the plain forms must be used.

    Importing numba takes 0.2 s. The first call of ``farthest`` compiles it for 5 s, that of
    ``nearest`` for 1 to 4 s, once per dtype; later processes read the compiled form from a file.
    """
    return _kernels()


@cache
def _kernels() -> ModuleType | None:
    try:
        from mops_lightning.ops import kernels
    except ImportError:
        return None
    return kernels if _fused() is not None else None


@cache
def _fused() -> bool | None:
    """Return whether torch sums squares by fused multiply-add; None if by something else."""
    # This depends on the processor. The product of two float32 is exact in float64.
    planes = torch.linspace(-1, 1, 3 * 512).sin().view(3, 512)
    total = sum_of_squares_(planes.clone()).numpy()
    x, y, z = planes.numpy()
    if np.array_equal(total, (x * x + y * y) + z * z):
        return False
    wide = np.square(planes.numpy(), dtype=np.float64)
    first = (wide[1] + (x * x)).astype(np.float32)
    return True if np.array_equal(total, (wide[2] + first).astype(np.float32)) else None


def farthest(
    points: Tensor, steps: int, start: int | Tensor = 0, distances: Tensor | None = None
) -> Tensor | None:
    """Repeatedly choose the point with the largest distance and update the distances.

    Args:
        points: ``(B, N, C)``.
        steps: number of points to choose, at most the number of points that are not chosen.
        start: row of the first point, one for all clouds or ``(B,)``.
        distances: ``(B, N)`` initial squared distances instead of a first point; -1 marks chosen
            points.

    Returns:
        ``(B, steps)`` int64, the lowest row in case of ties.
    """
    module = kernels()
    if module is None or points.device.type != "cpu" or points.numel() == 0:
        return None
    planes = _planes(points)
    if distances is None:
        initial = np.full((len(points), points.shape[1]), np.finfo(planes.dtype).max, planes.dtype)
        if isinstance(start, int):
            initial[:, start] = np.inf
        else:
            initial[np.arange(len(initial)), start.numpy()] = np.inf
    else:
        initial = np.ascontiguousarray(distances.numpy())
    bits = initial.view(_integer(planes))
    fixed = (steps, points.shape[2], FARTHEST_LEAF, _fused())
    work = steps * points.shape[1] * len(points)
    return _rows(
        lambda cloud: module.farthest(*cloud, *fixed), zip(planes, bits, strict=True), work
    )


def nearest(queries: Tensor, points: Tensor) -> Tensor | None:
    """Find the nearest point for every query.

    Args:
        queries: ``(B, M, C)``.
        points: ``(B, N, C)``.

    Returns:
        ``(B, M)`` int64, the lowest row in case of ties.
    """
    module = kernels()
    if module is None or points.device.type != "cpu" or not (points.numel() and queries.numel()):
        return None
    planes = _planes(points)
    flat = queries.detach().to(distance_dtype(points)).contiguous().flatten(1).numpy()
    scratch = np.empty((len(points), points.shape[1]), _integer(planes))
    fixed = (points.shape[2], NEAREST_LEAF, _fused())
    clouds = zip(planes, flat, scratch, strict=True)
    work = NEAREST_LEAF * (points.shape[1] + queries.shape[1]) * len(points)
    return _rows(lambda cloud: module.nearest(*cloud, *fixed), clouds, work)


def _planes(points: Tensor) -> Array:
    """Return a copy ``(B, C·N)``, one channel after the other, which may be overwritten."""
    values = points.detach().to(distance_dtype(points)).numpy()
    return np.array(values.transpose(0, 2, 1), order="C").reshape(len(values), -1)


def _integer(floats: Array) -> Any:
    """Return the integers of the same width."""
    return np.int32 if floats.dtype == np.float32 else np.int64


def _rows(
    function: Callable[[tuple[Array, ...]], Array], clouds: Iterable[tuple[Array, ...]], work: int
) -> Tensor | None:
    """Return the rows chosen from every cloud, computed in threads where that is faster."""
    workers = torch.get_num_threads() if work >= THREADS_MIN_WORK else 1
    if workers == 1:
        rows = [function(cloud) for cloud in clouds]
    else:
        with ThreadPoolExecutor(workers) as pool:
            rows = list(pool.map(function, clouds))
    if not all(map(len, rows)):  # points that are not finite
        return None
    return torch.from_numpy(rows[0][None] if len(rows) == 1 else np.stack(rows))
