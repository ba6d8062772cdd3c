"""Points of a pair of clouds that stand for all of them in one step of registration."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mops_lightning.errors import UserError
from mops_lightning.ops.caratheodory import same_sum
from mops_lightning.ops.normals import estimate_normals
from mops_lightning.ops.scalars import is_real_number, is_whole_number, python_number

LEAST = 29
"""Least number of points: 21 entries of H, 6 of b, the error and the number of residuals."""

LARGEST = 1e140
"""Largest summand: squares of sums of these are finite."""

Array = NDArray[np.float64]


class Coreset(NamedTuple):
    """Points with weights.

    Attributes:
        rows: ``(k,)`` int64 rows of the source, ascending.
        weights: ``(k,)`` above 0; their sum is the number of residuals.
    """

    rows: NDArray[np.int64]
    weights: Array


class Residuals(NamedTuple):
    """Point-to-plane residuals of a source.

    Attributes:
        rows: ``(n,)`` rows of the source that have a target point.
        values: ``(n,)`` distances from the planes of the nearest target points, signed.
        jacobians: ``(n, 6)`` their derivatives by a turn about the mean of the target (radians),
            then a shift, both after the pose.
    """

    rows: NDArray[np.int64]
    values: Array
    jacobians: Array


def coreset(
    source: Any,
    target: Any,
    pose: Any,
    m: int,
    *,
    normals: Any = None,
    max_distance: float | torch.Tensor = np.inf,
) -> Coreset:
    """Choose points and weights of a source with which a Gauss–Newton step is that of all points.

    Koide et al., "Exact Point Cloud Downsampling for Fast and Accurate Global Trajectory
    Optimization", IROS 2023 (arXiv 2307.02948): the weighted Hessian H = Σ w J Jᵀ, b = Σ w J r and
    error Σ w r² of the chosen point-to-plane residuals equal those of all residuals, up to
    rounding. Equality holds for the correspondences at this pose, and for turns about any centre.
    It is not a sample of the shape: points are chosen for the sums alone.

    Args:
        source: ``(N, 3)`` points, an array or a tensor; one cloud, no batch ``(B, N, 3)``.
        target: ``(K, 3)`` points.
        pose: ``(4, 4)`` rigid motion from source to target, at which residuals are taken.
        m: largest number of points, at least 29; a whole number of Python, NumPy or torch.
        normals: ``(K, 3)`` unit normals of the target; None: they are estimated.
        max_distance: source points without a target point within it have no residual; in the
            clouds' unit.

    Returns:
        At most ``m`` rows of the source, and their weights. All residuals with weight 1 where there
        are no more than ``m``.

    Raises:
        UserError: an argument has a wrong shape or value, or no source point is near the target.

    Example:
        >>> import numpy as np
        >>> from mops_lightning import coreset
        >>> points = np.random.default_rng(0).random((1000, 3))
        >>> rows, weights = coreset(points[:500], points[500:], np.eye(4), 29)
        >>> len(rows) <= 29, round(float(weights.sum()))
        (True, 500)
    """
    size = python_number(m)
    if not is_whole_number(size) or size < LEAST:
        raise UserError(f"m must be a whole number of at least {LEAST}, got {m!r:.99}.")
    residuals = point_to_plane(source, target, pose, normals, max_distance)
    number = len(residuals.rows)
    if number <= size:
        return Coreset(residuals.rows, np.ones(number))
    with np.errstate(over="ignore", invalid="ignore"):
        vectors = _summands(residuals)
    if not np.abs(vectors).max() < LARGEST:
        raise UserError(
            "the sums of residuals are too large for float64. Give normals of length 1, and "
            "smaller coordinates."
        )
    places, weights = _with_equal_sums(vectors, int(size))
    order = np.argsort(places)
    return Coreset(residuals.rows[places[order]], weights[order])


def _with_equal_sums(vectors: Array, m: int) -> tuple[NDArray[np.int64], Array]:
    """Return m rows of vectors and their weights, whose weighted sum is that of all vectors.

    The vectors are dealt to as many groups as m allows, and each group keeps its own sum.
    """
    groups = m // LEAST
    places = []
    weights = []
    for group in range(groups):
        members = np.arange(group, len(vectors), groups)
        keep = len(range(group, m, groups))
        rows, weights_of_rows = same_sum(vectors[members], keep)
        places.append(members[rows])
        weights.append(weights_of_rows)
    return np.concatenate(places), np.concatenate(weights)


def point_to_plane(
    source: Any,
    target: Any,
    pose: Any,
    normals: Any = None,
    max_distance: float | torch.Tensor = np.inf,
) -> Residuals:
    """Return the residuals of all source points at a pose; see ``coreset`` for the arguments."""
    points = _cloud("source", source)
    plane_points = _cloud("target", target)
    motion = _motion(pose)
    reach = python_number(max_distance)
    if not is_real_number(reach) or not reach > 0:
        raise UserError(f"max_distance must be a number above 0, got {max_distance!r:.99}.")
    directions = estimate_normals(plane_points)
    if normals is not None:
        directions = _cloud("normals", normals)
    if directions.shape != plane_points.shape:
        raise UserError(
            f"normals must be one per target point, {plane_points.shape}, got {directions.shape}."
        )
    # Around the mean: products with coordinates of a map would lose digits.
    centre = plane_points.mean(0)
    plane_points = plane_points - centre
    moved = points @ motion[:3, :3].T + (motion[:3, 3] - centre)
    neighbours: Any = cKDTree(plane_points).query(moved)
    distance, nearest = neighbours
    rows = np.flatnonzero(distance <= reach)
    if not len(rows):
        raise UserError("no source point is within max_distance of the target at this pose.")
    moved = moved[rows]
    nearest = nearest[rows]
    across = directions[nearest]
    values = np.einsum("ni,ni->n", across, moved - plane_points[nearest])
    jacobians = np.concatenate([np.cross(moved, across), across], axis=1)
    return Residuals(rows, values, jacobians)


def _summands(residuals: Residuals) -> Array:
    """Return what each residual adds to H (its upper triangle), b and the error, ``(n, 28)``."""
    rows, columns = np.triu_indices(6)
    jacobians = residuals.jacobians
    products = jacobians[:, rows] * jacobians[:, columns]
    slopes = jacobians * residuals.values[:, None]
    return np.column_stack([products, slopes, np.square(residuals.values)])


def _cloud(name: str, value: Any) -> Array:
    """Return finite points ``(N, 3)`` in float64."""
    points = _numbers(name, value, "(N, 3)")
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise UserError(f"{name} must have shape (N, 3), N at least 1, got {points.shape}.")
    if not np.isfinite(points).all():
        raise UserError(f"{name} must be finite, got NaN or infinity.")
    return points


def _motion(pose: Any) -> Array:
    """Return a rigid motion ``(4, 4)`` in float64."""
    motion = _numbers("pose", pose, "(4, 4)")
    if motion.shape != (4, 4):
        raise UserError(f"pose must be a (4, 4) rigid motion, got shape {motion.shape}.")
    if not np.isfinite(motion).all():
        raise UserError("pose must be finite, got NaN or infinity.")
    rotation = motion[:3, :3]
    is_orthogonal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    is_rotation = is_orthogonal and np.linalg.det(rotation) > 0
    if not is_rotation or not np.allclose(motion[3], [0, 0, 0, 1]):
        raise UserError(
            "pose must be a (4, 4) rigid motion: a rotation and a shift, with (0, 0, 0, 1) below; "
            f"got {motion.tolist()}."
        )
    return motion


def _numbers(name: str, value: Any, shape: str) -> Array:
    """Return an array, a tensor or lists of real numbers in float64."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu()
        if value.is_floating_point():  # NumPy has no bfloat16
            value = value.double()
    try:
        array = np.asarray(value)
        if np.iscomplexobj(array):
            raise TypeError("complex numbers")
        return array.astype(np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{name} must be numbers {shape}, got {type(value).__name__}.") from None
