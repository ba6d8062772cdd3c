"""Farthest points of arrays and tensors of coordinates, with nothing around the compiled loops.

The rows are those of ``FPSSampler.downsample``. Arrays are sampled without importing torch.
"""

import sys
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.ops.farthest import FARTHEST, rows_from_start
from mops_lightning.ops.keys import SeededOrder
from mops_lightning.ops.workers import number_of_threads
from mops_lightning.samplers.budget import Size, number_of

if TYPE_CHECKING:
    from torch import Tensor


def downsample(
    points: Any,
    size: Size | Any,
    seed: int,
    start: int | str | None,
) -> tuple[Any, Any] | None:
    """Choose farthest points of one cloud or a batch.

    Args:
        points: ``(N, 3)`` or ``(B, N, 3)``, an array or a tensor on the CPU.
        size: number of points, or their share.
        seed: see ``downsample``.
        start: see there.

    Returns:
        The points and their rows, or None for input of another kind, or that is invalid.
    """
    array = _as_array(points)
    if array is None or not isinstance(size, int | float):
        return None
    number = array.shape[-2]
    m = number_of(size, number)
    has_size = len(array) > 0 and 1 <= m <= number
    if not has_size or not _is_start(start, number):
        return None
    is_one = array.ndim == 2
    clouds = array
    if is_one:
        clouds = array[None]
    order = SeededOrder(seed, True)
    chosen = rows_from_start(clouds, m, order, start, threads=number_of_threads())
    if chosen is None:
        return None
    rows = chosen
    if is_one:
        rows = chosen[0]
    if isinstance(points, np.ndarray):
        return _gathered(array, rows), rows
    return _tensors(points, rows)


def _as_array(points: Any) -> NDArray[Any] | None:
    """Return the coordinates as an array that shares the memory, or None for other input."""
    if isinstance(points, np.ndarray):
        array = np.asarray(points)  # without subclasses, such as np.memmap
    elif _is_plain_tensor(points):
        array = points.detach().numpy()
    else:
        return None
    is_float = array.dtype in (np.float32, np.float64) and array.dtype.isnative
    is_clouds = array.ndim in (2, 3) and array.shape[-1] == 3
    if not is_float or not is_clouds:
        return None
    return array


def _is_plain_tensor(points: Any) -> bool:
    """Return whether this is a dense tensor of floats on the CPU, without importing torch."""
    torch = sys.modules.get("torch")
    if torch is None or not isinstance(points, torch.Tensor):
        return False
    is_float = points.dtype in (torch.float32, torch.float64)
    return bool(points.is_cpu and is_float and not points.is_sparse)


def _is_start(start: Any, number: int) -> bool:
    """Return whether a first point is valid, of so many points."""
    if isinstance(start, int) and not isinstance(start, bool):
        return 0 <= start < number
    is_word = isinstance(start, str) and start == FARTHEST
    return start is None or is_word


def _gathered(array: NDArray[Any], rows: NDArray[np.int64]) -> NDArray[Any]:
    if array.ndim == 2:
        return array[rows]
    return np.take_along_axis(array, rows[..., None], 1)


def _tensors(points: "Tensor", rows: NDArray[np.int64]) -> "tuple[Tensor, Tensor]":
    import torch

    indices = torch.from_numpy(rows)
    if points.ndim == 2:
        return points.detach()[indices], indices
    width = points.shape[2]
    places = indices[..., None].expand(-1, -1, width)
    return points.detach().gather(1, places), indices
