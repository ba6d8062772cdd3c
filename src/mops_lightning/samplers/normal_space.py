"""Normal-space sampling, a baseline of registration."""

import numpy as np
from numpy.typing import NDArray

from mops_lightning.ops.stability import places_by_direction
from mops_lightning.samplers.by_normals import ByNormals


class NormalSpaceSampler(ByNormals):
    """Choose points whose normals are spread over all directions.

    Rusinkiewicz and Levoy, "Efficient Variants of the ICP Algorithm", 3DIM 2001. Small features,
    whose normals are rare, keep as many points as large planes. See
    ``ops.stability.places_by_direction`` for the buckets of directions.

    Flexible and nested. The sample depends on the seed and the cloud only. It runs on the CPU.

    Args:
        m: largest number of points to return.
        seed: determines the order in which a bucket gives its points.
        neighbours: number of nearest points through which planes are fitted, from 3.

    Raises:
        UserError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import NormalSpaceSampler
        >>> output = NormalSpaceSampler(m=8)(torch.rand(2, 64, 3))  # (B, N, 3)
        >>> output.points.shape, output.indices.shape  # (B, m, 3), (B, m)
        (torch.Size([2, 8, 3]), torch.Size([2, 8]))
    """

    def choose(
        self, points: NDArray[np.float64], normals: NDArray[np.float64], m: int
    ) -> NDArray[np.int64]:
        """Return the places ``(m,)`` of points ``(N, 3)`` with normals ``(N, 3)``."""
        return places_by_direction(normals, m)
