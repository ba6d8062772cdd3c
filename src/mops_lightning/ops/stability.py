"""Points that hold a pose in point-to-plane registration.

A small motion, rotation r and translation t, moves point p along its normal n by ⟨p × n, r⟩ +
⟨n, t⟩. The vectors v = (p × n, n) of the points therefore say which motions a sample resists:
Σ v vᵀ is the information matrix of the pose, and the Hessian of ICP.
"""

import numpy as np
from numpy.typing import NDArray

from mops_lightning.ops.kernel_stability import cover_least_held, grow_information
from mops_lightning.ops.kernel_steady import grow_steady

PRIOR = 1e-3
"""Information about every direction before the first point, in units of that of one point."""

RIDGE = 1e-2
"""The same for ``steady_places``, where it is the knowledge of the pose before registration."""

HELD = 1e-12
"""Smallest share of the largest eigenvalue of Σ v vᵀ that is more than rounding."""

ROTATION = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
"""The directions of ``plane_rows`` that turn the points."""

CELLS = 5
"""Cells along each axis of a face of the cube of normals; odd, so that an axis is inside a cell."""


def plane_rows(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vectors (p × n, n) ``(N, 6)`` of points around their mean, scaled.

    The mean distance from the centre is 1, so that a turn by one radian and a shift by one unit
    move the points equally far (Gelfand et al. 2003).

    Args:
        points: ``(N, 3)``.
        normals: ``(N, 3)``, of either sign.
    """
    centred = points - points.mean(0)
    distances = np.linalg.norm(centred, axis=1)
    scale = float(distances.mean()) or 1.0
    turns = np.cross(centred / scale, normals)
    return np.concatenate([turns, normals], axis=1)


def stable_places(rows: NDArray[np.float64], m: int) -> NDArray[np.int64]:
    """Choose m points that hold all directions of motion about equally.

    Gelfand, Ikemoto, Rusinkiewicz and Levoy, "Geometrically Stable Sampling for the ICP Algorithm",
    3DIM 2003: the directions are the eigenvectors of Σ v vᵀ over all points. The next point is the
    one with the largest ⟨v, x⟩² for the direction x whose sum over the chosen points is smallest.
    Directions that no point holds, such as shifts along a floor, are left out: choices for them
    would follow rounding errors.

    Args:
        rows: ``(N, 6)`` from ``plane_rows``.
        m: number of points, at most N.

    Returns:
        ``(m,)`` places, in the order of choice; of equal points the lowest place.
    """
    covariance = np.einsum("ni,nj->ij", rows, rows)  # the same sum for any number of threads
    values, directions = np.linalg.eigh(covariance)
    is_held = values >= HELD * values[-1]
    directions = directions[:, is_held]
    projections = np.einsum("ni,ij->nj", rows, directions)
    squares = np.square(projections)
    orders = np.argsort(-squares.T, axis=1, kind="stable")
    places: NDArray[np.int64] = cover_least_held(squares, orders, m)
    return places


def informative_places(rows: NDArray[np.float64], m: int) -> NDArray[np.int64]:
    """Choose m points, each of which raises the log determinant of the information matrix most.

    The gain is submodular, so that the greedy choice has at least 1 − 1/e of the largest gain of
    any m points (Nemhauser, Wolsey and Fisher, Mathematical Programming 1978).

    Args:
        rows: ``(N, 6)`` from ``plane_rows``.
        m: number of points, at most N.

    Returns:
        ``(m,)`` places, in the order of choice; of equal gains the lowest place.
    """
    contiguous_rows = np.ascontiguousarray(rows)
    places: NDArray[np.int64] = grow_information(contiguous_rows, PRIOR, m)
    return places


def steady_places(
    rows: NDArray[np.float64], spread: NDArray[np.float64], m: int
) -> NDArray[np.int64]:
    """Choose m points from which the error of the rotation is expected to be smallest.

    Least squares over residuals with standard deviations s has the covariance H⁻¹·W·H⁻¹, with
    H = Σ v vᵀ and W = Σ s² v vᵀ (White, Econometrica 1980). Each point is the one after which the
    part of its trace that belongs to the rotation is smallest.

    Args:
        rows: ``(N, 6)`` from ``plane_rows``.
        spread: ``(N,)`` the standard deviations s, above 0, in any unit.
        m: number of points, at most N.

    Returns:
        ``(m,)`` places, in the order of choice; of equal traces the lowest place.
    """
    variances = np.square(spread / np.median(spread))
    contiguous_rows = np.ascontiguousarray(rows)
    places: NDArray[np.int64] = grow_steady(contiguous_rows, variances, ROTATION, RIDGE, m)
    return places


def places_by_direction(normals: NDArray[np.float64], m: int) -> NDArray[np.int64]:
    """Choose m points whose normals are spread over all directions.

    Rusinkiewicz and Levoy, "Efficient Variants of the ICP Algorithm", 3DIM 2001: normals are put
    into buckets by their direction, and the buckets give points in turn. Here, a bucket is a cell
    on the faces of a cube, in equal angles, and a normal and its opposite are in the same one.

    Args:
        normals: ``(N, 3)``, in the order in which a bucket gives its points.
        m: number of points, at most N.

    Returns:
        ``(m,)`` places: the first points of all buckets, then the second ones, …; within a round in
        the order of the points.
    """
    bucket = _buckets(normals)
    by_bucket = np.argsort(bucket, kind="stable")
    counts = np.bincount(bucket)
    starts = np.cumsum(counts) - counts
    start_of_each = starts[bucket[by_bucket]]
    places_in_bucket = np.arange(len(normals)) - start_of_each
    rounds = np.empty(len(normals), np.int64)
    rounds[by_bucket] = places_in_bucket
    return np.argsort(rounds, kind="stable")[:m]


def _buckets(normals: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the cell ``(N,)`` of every normal on the cube, 0 to 3·CELLS² − 1."""
    largest_axis = np.abs(normals).argmax(1)
    face = largest_axis[:, None]
    other_axes = (face + np.array([1, 2])) % 3
    along = np.take_along_axis(normals, face, 1)
    across = np.take_along_axis(normals, other_axes, 1)
    angles = np.arctan(across / along)
    positions = angles / (np.pi / 4)  # from -1 to 1
    cells = (positions + 1) / 2 * CELLS
    cells = np.clip(cells.astype(np.int64), 0, CELLS - 1)
    rows, columns = cells.T
    return (largest_axis * CELLS + rows) * CELLS + columns
