"""Registration by small_gicp (Koide, Journal of Open Source Software 2024)."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mops_lightning.errors import UserError

Points = NDArray[np.float64]

REGISTRATIONS = {"plane": "PLANE_ICP", "gicp": "GICP"}
"""Kinds of registration, and small_gicp's names of them."""

LEAST = 10
"""Fewer points are refused by small_gicp."""

NEIGHBOURS = 12
"""Nearest points from which normals and covariances are estimated."""

LIMITS = {
    "max_iterations": 60,
    "rotation_epsilon": 1e-5,
    "translation_epsilon": 1e-5,
}
"""Far below the errors that are measured, in radians and the clouds' unit."""


def small_gicp() -> Any:
    """Return the library.

    Raises:
        UserError: it is not installed.
    """
    try:
        import small_gicp as library
    except ImportError:
        raise UserError("--task icp needs an extra: pip install 'mops-lightning[icp]'.") from None
    return library


@dataclass(frozen=True)
class Target:
    """A cloud to which others are aligned, with its normals, covariances and tree."""

    cloud: Any
    tree: Any


def prepare_target(points: Points) -> Target:
    """Estimate the normals and covariances of points ``(K, 3)``, and build their tree."""
    library = small_gicp()
    cloud = library.PointCloud(points)
    tree = library.KdTree(cloud)
    library.estimate_normals_covariances(cloud, tree, min(NEIGHBOURS, len(points)))
    return Target(cloud, tree)


def prepare_source(points: Points, registration: str) -> Any:
    """Return points ``(m, 3)`` for ``align``, with covariances where the registration needs them.

    The covariances are those of the given points, as in odometry, where nothing else is kept.
    """
    library = small_gicp()
    cloud = library.PointCloud(points)
    if registration == "gicp":
        library.estimate_covariances(cloud, num_neighbors=min(NEIGHBOURS, len(points)))
    return cloud


def align(
    target: Target, source: Any, start: Points, registration: str, max_distance: float
) -> Points:
    """Return the pose ``(4, 4)`` from source to target.

    Args:
        target: from ``prepare_target``.
        source: from ``prepare_source``.
        start: ``(4, 4)`` the first pose.
        registration: one of ``REGISTRATIONS``.
        max_distance: of corresponding points, in the clouds' unit.
    """
    result = small_gicp().align(
        target.cloud,
        source,
        target.tree,
        init_T_target_source=start,
        registration_type=REGISTRATIONS[registration],
        max_correspondence_distance=max_distance,
        **LIMITS,
    )
    found: Points = result.T_target_source
    return found


@dataclass(frozen=True)
class PoseError:
    """What is left between two poses.

    Attributes:
        degrees: angle between their rotations.
        shift: distance between the two places of the source's mean, in the clouds' unit.
        seconds: processor time of the alignment.
    """

    degrees: float
    shift: float
    seconds: float


def timed_error(
    target: Target,
    source: Any,
    start: Points,
    registration: str,
    max_distance: float,
    *,
    truth: Points,
    centre: Points,
) -> PoseError:
    """Align a source, and compare the pose with the truth.

    Args:
        target: see ``align``.
        source: see ``align``.
        start: see ``align``.
        registration: see ``align``.
        max_distance: see ``align``.
        truth: ``(4, 4)`` the true pose.
        centre: ``(3,)`` mean of the whole source.
    """
    began = time.process_time()
    found = align(target, source, start, registration, max_distance)
    seconds = time.process_time() - began
    degrees, shift = pose_difference(found, truth, centre)
    return PoseError(degrees, shift, seconds)


def pose_difference(found: Points, truth: Points, centre: Points) -> tuple[float, float]:
    """Return the angle between two rotations in degrees, and how far the poses move a place apart.

    Args:
        found: ``(4, 4)`` a pose.
        truth: ``(4, 4)`` another.
        centre: ``(3,)`` the place. The origin may be kilometres from a scan in map coordinates,
            where the smallest angle moves it far.
    """
    rotation = found[:3, :3]
    true_rotation = truth[:3, :3]
    turn = Rotation.from_matrix(rotation.T @ true_rotation)
    degrees = float(np.degrees(turn.magnitude()))
    apart = (rotation - true_rotation) @ centre + found[:3, 3] - truth[:3, 3]
    return degrees, float(np.linalg.norm(apart))
