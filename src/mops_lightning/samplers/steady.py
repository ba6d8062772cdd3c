"""Greedy sampling by the expected error of the rotation, a baseline of registration."""

import numpy as np
from numpy.typing import NDArray

from mops_lightning.ops.stability import plane_rows, steady_places
from mops_lightning.samplers.by_normals import ByNormals


class SteadySampler(ByNormals):
    """Choose points from which the rotation is found with the smallest expected error.

    Each point is the one after which the part of the pose's covariance that belongs to the rotation
    has the smallest trace (greedy A-optimal design), if the residuals of all points are equally
    large; see ``ops.stability.steady_places``. ``PoseSampler`` learns how large they are.

    Flexible and nested. The sample depends on the seed and the cloud only. It runs on the CPU.

    Args:
        m: largest number of points to return.
        seed: determines how ties are broken.
        neighbours: number of nearest points through which planes are fitted, from 3.

    Raises:
        UserError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import SteadySampler
        >>> output = SteadySampler(m=8)(torch.rand(2, 64, 3))  # (B, N, 3)
        >>> output.points.shape, output.indices.shape  # (B, m, 3), (B, m)
        (torch.Size([2, 8, 3]), torch.Size([2, 8]))
    """

    def choose(
        self, points: NDArray[np.float64], normals: NDArray[np.float64], m: int
    ) -> NDArray[np.int64]:
        """Return the places ``(m,)`` of points ``(N, 3)`` with normals ``(N, 3)``."""
        rows = plane_rows(points, normals)
        equal_spread = np.ones(len(points))
        return steady_places(rows, equal_spread, m)
