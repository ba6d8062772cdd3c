"""Sample elimination with the points of neighbouring cells only, where numba is installed."""

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.ops import compiled

FINEST = 2**20
"""Maximum number of cells along an axis: three positions fit into an integer of 64 bits."""

Places = NDArray[np.int64]


def eliminate_by_cells(points: Tensor, m: int, reach: float, scale: float) -> Tensor | None:
    """Remove the most crowded point of a cloud until m remain; see ``PoissonSampler``.

    Args:
        points: ``(N, 3)`` float64.
        m: number of points that remain, 1 ≤ m ≤ N.
        reach: distance from which weights are 0, positive.
        scale: factor of the weights before they are truncated to integers.

    Returns:
        ``(m,)`` int64 rows, ascending; None where the plain form must be used.
    """
    if compiled.kernels() is None or points.device.type != "cpu" or points.shape[1] != 3:
        return None
    from mops_lightning.ops.elimination_kernels import eliminate

    array = points.numpy()
    low = array.min(0)
    extent = float((array.max(0) - low).max())
    side = max(reach, extent / FINEST) * (1 + 1e-9)
    if not extent < np.inf or not side < np.inf:  # coordinates are not finite, or too large
        return None
    position = ((array - low) / side).astype(np.int64) + 1  # so that no neighbour is below 0
    key = (position[:, 0] * 2 * FINEST + position[:, 1]) * 2 * FINEST + position[:, 2]
    order = key.argsort(kind="stable")
    cells, starts, cell_of, numbers = np.unique(
        key[order], return_index=True, return_inverse=True, return_counts=True
    )
    planes = np.ascontiguousarray(array[order].T)
    remains = eliminate(planes, order, starts, numbers, cell_of, _around(cells), m, reach, scale)
    return torch.from_numpy(np.flatnonzero(remains))


def _around(cells: Places) -> NDArray[np.int32]:
    """Return each cell and its neighbours as places in ``cells``, ``(K, 27)``; -1 for none."""
    around = np.empty((len(cells), 27), np.int32)
    for column, (x, y, z) in enumerate(itertools.product((-1, 0, 1), repeat=3)):
        wanted = cells + ((x * 2 * FINEST + y) * 2 * FINEST + z)
        found = np.minimum(np.searchsorted(cells, wanted), len(cells) - 1)
        around[:, column] = np.where(cells[found] == wanted, found, -1)
    return around
