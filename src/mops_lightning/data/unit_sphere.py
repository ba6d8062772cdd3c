"""Moving clouds in any unit to the unit sphere and back.

In float64, because float32 has too few digits for coordinates of a map.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class UnitSphere(NamedTuple):
    """A cloud's centre ``(3,)`` and its largest distance from a point, or 1 for equal points."""

    centre: NDArray[np.float64]
    radius: float

    @classmethod
    def around(cls, points: NDArray[np.float64]) -> "UnitSphere":
        """Measure a cloud ``(n, 3)``."""
        centre = points.sum(0) / len(points)
        return cls(centre, largest_distance(points, centre) or 1.0)

    def normalise(self, points: NDArray[np.float64]) -> Tensor:
        """Return points ``(n, 3)`` of the cloud in the unit sphere, float32, as for training."""
        return torch.from_numpy(((points - self.centre) / self.radius).astype(np.float32))

    def restore(self, points: Tensor) -> NDArray[np.float64]:
        """Return points ``(n, 3)`` of the unit sphere in the file's own unit."""
        restored: NDArray[np.float64] = points.double().numpy() * self.radius + self.centre
        return restored


def largest_distance(points: NDArray[np.float64], centre: NDArray[np.float64]) -> float:
    """Return the largest distance of points ``(n, 3)`` from ``centre`` ``(3,)``."""
    return float(np.linalg.norm(points - centre, axis=1).max(initial=0.0))
