"""Greedy sampling by the information about the pose, a baseline of registration."""

import numpy as np
from numpy.typing import NDArray

from mops_lightning.ops.stability import informative_places, plane_rows
from mops_lightning.samplers.by_normals import ByNormals


class InformationSampler(ByNormals):
    """Choose points that make the information about the pose largest.

    The information matrix is that of point-to-plane registration, Σ v vᵀ with v = (p × n, n). Each
    point is the one that raises the log determinant most (greedy D-optimal design); see
    ``ops.stability.informative_places``.

    Flexible and nested. The sample depends on the seed and the cloud only. It runs on the CPU.

    Args:
        m: largest number of points to return.
        seed: determines how ties are broken.
        neighbours: number of nearest points through which planes are fitted, from 3.

    Raises:
        UserError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import InformationSampler
        >>> output = InformationSampler(m=8)(torch.rand(2, 64, 3))  # (B, N, 3)
        >>> output.points.shape, output.indices.shape  # (B, m, 3), (B, m)
        (torch.Size([2, 8, 3]), torch.Size([2, 8]))
    """

    def choose(
        self, points: NDArray[np.float64], normals: NDArray[np.float64], m: int
    ) -> NDArray[np.int64]:
        """Return the places ``(m,)`` of points ``(N, 3)`` with normals ``(N, 3)``."""
        rows = plane_rows(points, normals)
        return informative_places(rows, m)
