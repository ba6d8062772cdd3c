"""Numbers that describe the surface around every point, whatever the cloud's place and unit."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mops_lightning.ops.kernel_normals import ellipsoids

SCALES = (6, 12, 24)
"""Numbers of nearest points, the point itself included, of the neighbourhoods of a point."""

PLANE = 12
"""The scale whose planes give the normals; small_gicp estimates them from as many points."""

PER_SCALE = 8
PER_POINT = 4
FEATURES = PER_SCALE * len(SCALES) + PER_POINT
"""How many numbers describe a point."""

LEAST = 1e-2
"""Added before logarithms, in units of the spacing or of one minus a cosine."""

Values = NDArray[np.float64]


class Neighbourhoods(NamedTuple):
    """The surroundings of N points.

    Attributes:
        features: ``(N, FEATURES)`` float64.
        normals: ``(N, 3)`` unit vectors, of either sign.
    """

    features: Values
    normals: Values


def describe_neighbourhoods(points: Values) -> Neighbourhoods:
    """Describe the neighbourhood of every point at several scales.

    Rotations, reflections, shifts and scalings of the cloud change no feature. At each scale these
    are logarithms, in units of the median spacing of the points: the half axes of the neighbours,
    the point's distances from their mean across and along their plane, the distance of the last
    neighbour, and how much normals differ (the mean and the largest difference). For each point:
    its distance from the cloud's mean, the same along the normal, the lever arm |p × n|, and the
    spacing, which are in units of the mean distance from the cloud's mean.

    Args:
        points: ``(N, 3)`` finite, N ≥ 1.
    """
    centred = points - points.mean(0)
    mean_distance = float(np.linalg.norm(centred, axis=1).mean())
    centred = centred / (mean_distance or 1.0)
    most = min(SCALES[-1], len(points))
    distances, nearest = cKDTree(centred).query(centred, k=most)
    distances = np.reshape(distances, (len(points), most))
    nearest = np.reshape(nearest, (len(points), most))
    last_of_finest = min(SCALES[0], most) - 1
    spacing = float(np.median(distances[:, last_of_finest])) or 1.0

    lengths: list[Values] = []
    normals = np.empty_like(centred)
    for k in SCALES:
        neighbours = np.ascontiguousarray(nearest[:, :k])
        numbers, directions = ellipsoids(centred, neighbours)
        last = min(k, most) - 1
        lengths += [numbers, distances[:, last, None]]
        if k == PLANE:
            normals = directions
    relative = np.concatenate(lengths, axis=1) / spacing
    columns = [np.log(relative + LEAST)]
    for k in SCALES:
        columns.append(_differences(normals, nearest[:, :k]))
    columns.append(_levers(centred, normals, spacing))
    return Neighbourhoods(np.concatenate(columns, axis=1), normals)


def _differences(normals: Values, nearest: NDArray[np.int64]) -> Values:
    """Return the mean and the largest difference ``(N, 2)`` of normals, as logarithms."""
    near_normals = normals[nearest]
    cosines = np.abs(np.einsum("ni,nki->nk", normals, near_normals))
    least = np.stack([cosines.mean(1), cosines.min(1)], axis=1)
    differences = 1 - np.minimum(least, 1)
    return np.log(differences + LEAST)


def _levers(centred: Values, normals: Values, spacing: float) -> Values:
    """Return what depends on the place of a point in the cloud, ``(N, PER_POINT)``."""
    radius = np.linalg.norm(centred, axis=1)
    along = np.abs(np.einsum("ni,ni->n", centred, normals))
    across = np.cross(centred, normals)
    lever = np.linalg.norm(across, axis=1)
    log_lever = np.log(lever + LEAST)
    everywhere = np.full(len(centred), np.log(spacing))
    return np.stack([radius, along, log_lever, everywhere], axis=1)
