"""Moving clouds into the unit sphere, as in training, and back."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.data.formats.errors import BadCloudError


class UnitSphere(NamedTuple):
    """A cloud's centre ``(3,)`` and the largest distance of a point from it."""

    centre: NDArray[np.float64]
    radius: float

    def normalise(self, points: NDArray[np.float64]) -> Tensor:
        """Return points ``(n, 3)`` of the cloud in the unit sphere, float32."""
        return torch.from_numpy(((points - self.centre) / self.radius).astype(np.float32))

    def restore(self, points: Tensor) -> NDArray[np.float64]:
        """Return points ``(n, 3)`` of the unit sphere in the file's own unit."""
        restored: NDArray[np.float64] = points.double().numpy() * self.radius + self.centre
        return restored


def sum_of(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum ``(3,)`` of points ``(n, 3)``, which may be infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return points.sum(0)


def largest_distance(points: NDArray[np.float64], centre: NDArray[np.float64]) -> float:
    """Return the largest distance of points ``(n, 3)`` from ``centre`` ``(3,)``."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.linalg.norm(points - centre, axis=1).max(initial=0.0))


def unit_sphere(centre: NDArray[np.float64], distance: float, path: Path) -> UnitSphere:
    """Return the transform of a cloud with this centre and largest distance from it.

    Raises:
        BadCloudError: the distance is not finite.
    """
    if not np.isfinite(distance):
        raise BadCloudError(f"{path}: its coordinates are too large for float64 distances.")
    return UnitSphere(centre, distance or 1.0)
