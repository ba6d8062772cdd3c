"""Input, gathering, normalisation and memory layout of batched point clouds."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops import batches

BLOCK = 16384
"""Points that are measured at once."""


def as_tensor(name: str, value: Any) -> Tensor:
    """Return a tensor of an argument: a tensor, an array, or a list of whole numbers.

    Raises:
        UserError: it holds no numbers, or complex ones.
    """
    tensor = _converted(name, value)
    if tensor.is_complex():
        raise UserError(f"{name} must hold real numbers, got {tensor.dtype}. Try {name}.real.")
    return tensor


def _converted(name: str, value: Any) -> Tensor:
    if isinstance(value, np.ndarray):
        native = value.astype(value.dtype.newbyteorder("="), copy=False)  # files may be big-endian
        try:
            # torch takes neither negative strides nor memory that must not be written to.
            return torch.from_numpy(np.require(native, requirements=("C", "W")))
        except TypeError:
            raise UserError(f"{name} must hold numbers, got dtype {value.dtype}.") from None
    if isinstance(value, list | tuple) and name != "points":
        try:
            return torch.tensor(value)
        except (RuntimeError, TypeError, ValueError):
            raise UserError(f"{name} must be whole numbers, got {value!r:.99}.") from None
    if not isinstance(value, Tensor):
        raise UserError(f"{name} must be a tensor or an array, got {type(value).__name__}.")
    return value


def cloud_sizes(number: int, batch: Tensor, name: str = "batch") -> Tensor:
    """Return the number of points ``(B,)`` of every cloud; see ``ops.batches.cloud_sizes``."""
    numbers = batches.cloud_sizes(number, batch.cpu().numpy(), name)
    return torch.from_numpy(numbers)


def gather_points(points: Tensor, indices: Tensor) -> Tensor:
    """Select rows of every cloud.

    Args:
        points: ``(B, N, C)``.
        indices: ``(B, M)`` or ``(B, M, k)`` int64, rows of ``points``.

    Returns:
        ``(B, M, C)`` or ``(B, M, k, C)``; gradients flow to ``points``.
    """
    channels = points.shape[2]
    rows = indices.flatten(1)[..., None]
    rows = rows.expand(-1, -1, channels)
    return points.gather(1, rows).view(*indices.shape, channels)


def normalize_unit_sphere(points: Tensor) -> Tensor:
    """Centre every cloud at the origin and scale its largest norm to 1.

    Args:
        points: ``(B, N, C)``.

    Returns:
        ``(B, N, C)``; a cloud whose points all coincide becomes zeros.
    """
    centred = points - points.mean(1, keepdim=True)
    distances = torch.linalg.vector_norm(centred, dim=2, keepdim=True)
    radius = distances.amax(1, keepdim=True)
    # The mean of equal numbers can have a rounding error, which must not be scaled up.
    is_as_first = (points == points[:, :1]).all(2, keepdim=True)
    has_no_size = is_as_first.all(1, keepdim=True) | (radius == 0)
    divisor = torch.where(has_no_size, 1.0, radius)
    return torch.where(has_no_size, 0.0, centred / divisor)


class UnitSphere(NamedTuple):
    """A cloud's centre ``(3,)`` and its largest distance from a point, or 1 for equal points.

    In float64, because float32 has too few digits for coordinates of a map.
    """

    centre: NDArray[np.float64]
    radius: float

    @classmethod
    def around(cls, points: NDArray[np.float64]) -> "UnitSphere":
        """Measure a cloud ``(n, 3)``."""
        centre = points.sum(0) / len(points)
        radius = largest_distance(points, centre) or 1.0
        return cls(centre, radius)

    def normalise(self, points: NDArray[np.float64]) -> Tensor:
        """Return points ``(n, 3)`` of the cloud in the unit sphere, float32, as for training."""
        unit = np.empty(points.shape, np.float32)
        for block in _blocks(len(points)):
            centred = points[block] - self.centre
            unit[block] = centred / self.radius
        return torch.from_numpy(unit)

    def restore(self, points: Tensor) -> NDArray[np.float64]:
        """Return points ``(n, 3)`` of the unit sphere in the file's own unit."""
        unit = points.double().numpy()
        restored: NDArray[np.float64] = unit * self.radius + self.centre
        return restored


def largest_distance(points: NDArray[np.float64], centre: NDArray[np.float64]) -> float:
    """Return the largest distance of points ``(n, 3)`` from ``centre`` ``(3,)``."""
    largest = 0.0
    for block in _blocks(len(points)):
        centred = points[block] - centre
        distances = np.linalg.norm(centred, axis=1)
        largest = np.maximum(largest, distances.max())
    return float(largest)


def _blocks(number: int) -> Iterator[slice]:
    """Return slices of rows whose differences fit into a cache, and add little to the memory."""
    for first in range(0, number, BLOCK):
        yield slice(first, first + BLOCK)


def distance_dtype(points: Tensor) -> torch.dtype:
    """Return the dtype for comparing distances: at least float32, as half is too coarse."""
    return torch.promote_types(points.dtype, torch.float32)


def to_planes(points: Tensor) -> Tensor:
    """Convert ``(B, N, C)`` to contiguous ``(C, B, N)``, one plane per coordinate."""
    return points.permute(2, 0, 1).contiguous()


def zeros_if(is_needed: bool, like: Tensor) -> Tensor:
    """Return zeros of a tensor's shape for gradients that are needed, otherwise no values."""
    if is_needed:
        return torch.zeros_like(like)
    return like.new_empty([0] * like.ndim)
