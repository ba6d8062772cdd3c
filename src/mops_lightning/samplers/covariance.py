"""Covariance sampling, a baseline of registration."""

import numpy as np
from numpy.typing import NDArray

from mops_lightning.ops.stability import plane_rows, stable_places
from mops_lightning.samplers.by_normals import ByNormals


class CovarianceSampler(ByNormals):
    """Choose points that hold all rotations and translations about equally (stable ICP).

    Gelfand, Ikemoto, Rusinkiewicz and Levoy, "Geometrically Stable Sampling for the ICP Algorithm",
    3DIM 2003; see ``ops.stability.stable_places``.

    Flexible and nested. The sample depends on the seed and the cloud only. It runs on the CPU.

    Args:
        m: largest number of points to return.
        seed: determines how ties are broken.
        neighbours: number of nearest points through which planes are fitted, from 3.

    Raises:
        UserError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import CovarianceSampler
        >>> output = CovarianceSampler(m=8)(torch.rand(2, 64, 3))  # (B, N, 3)
        >>> output.points.shape, output.indices.shape  # (B, m, 3), (B, m)
        (torch.Size([2, 8, 3]), torch.Size([2, 8]))
    """

    def choose(
        self, points: NDArray[np.float64], normals: NDArray[np.float64], m: int
    ) -> NDArray[np.int64]:
        """Return the places ``(m,)`` of points ``(N, 3)`` with normals ``(N, 3)``."""
        rows = plane_rows(points, normals)
        return stable_places(rows, m)
