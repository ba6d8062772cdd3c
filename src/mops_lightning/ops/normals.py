"""Normals of the surface from which points were sampled."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mops_lightning.ops.kernel_normals import plane_normals

NEIGHBOURS = 12
"""Nearest points of a plane fit, the point itself included."""

PART = 2**16
"""Number of points whose neighbourhoods are in memory at a time."""


def estimate_normals(
    points: NDArray[np.float64], neighbours: int = NEIGHBOURS
) -> NDArray[np.float64]:
    """Return the unit normals of planes through the nearest points, of either sign.

    Hoppe et al., "Surface Reconstruction from Unorganized Points", SIGGRAPH 1992: the direction of
    least variance, found by Jacobi's method.

    Args:
        points: ``(N, 3)`` finite, N ≥ 1.
        neighbours: number of nearest points, the point itself included.

    Returns:
        ``(N, 3)``. Of points on a line, one of the directions across; of equal points, (0, 0, 1).
    """
    centred = points - points.mean(0)
    tree = cKDTree(centred)
    k = min(neighbours, len(points))
    normals = np.empty_like(centred)
    for start in range(0, len(points), PART):
        part = centred[start : start + PART]
        nearest = np.asarray(tree.query(part, k=k)[1], np.int64)
        nearest = nearest.reshape(len(part), -1)
        normals[start : start + PART] = plane_normals(centred, nearest)
    return normals


def upward_normals(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normals ``(N, 3)`` of points ``(N, 3)`` with the sign that points upwards.

    Points alone cannot tell inside from outside: of both directions, the one with a positive z is
    taken; where z is 0, with a positive y, then x.
    """
    normals = estimate_normals(points)
    x, y, z = normals.T
    is_down_in_plane = (y < 0) | ((y == 0) & (x < 0))
    is_down = (z < 0) | ((z == 0) & is_down_in_plane)
    upward: NDArray[np.float64] = np.where(is_down[:, None], -normals, normals)
    return upward
