"""Scans of one scene from several places, with files of their true motions."""

import numpy as np
from scipy.spatial.transform import Rotation

from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table


def room(number=3000, seed=0):
    """A made-up scan of two walls, a floor and a box, ``(number, 3)`` in metres."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 1, (number, 3)) * (6, 4, 2.5)
    flat = rng.integers(0, 3, number)
    points[np.arange(number), flat] = 0
    box = rng.uniform(-1, 1, (number // 4, 3))
    box /= np.abs(box).max(1, keepdims=True)
    points[: len(box)] = box * (0.5, 0.8, 0.4) + (3, 2, 0.4)
    return points


def pose(seed, angle=20.0, shift=1.0):
    """A random rigid motion ``(4, 4)``."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    angles = rng.uniform(-angle, angle, 3)
    matrix[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    matrix[:3, 3] = rng.uniform(-shift, shift, 3)
    return matrix


def moved(points, matrix):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def views(points, number, share=0.6, seed=0):
    """Cut a scan along x into overlapping views, each with a random half of its points."""
    rng = np.random.default_rng(seed)
    order = np.argsort(points[:, 0])
    width = int(share * len(points))
    starts = np.linspace(0, len(points) - width, number).astype(int)
    return [points[rng.permutation(order[a : a + width])[: width // 2]] for a in starts]


def write_scans(folder, clouds, poses, suffix=".npy"):
    """Write every cloud in coordinates of its own: a pose maps these to those of the clouds."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, (points, matrix) in enumerate(zip(clouds, poses, strict=True)):
        local = moved(points, np.linalg.inv(matrix))
        WRITERS[suffix](folder / f"scan_{i}{suffix}", Table(local))


def write_poses(path, poses):
    np.savetxt(path, [matrix[:3].ravel() for matrix in poses])


def write_log(path, poses, pairs):
    """Write pairs (i, j) as in 3DMatch: the matrix maps scan j to scan i."""
    with path.open("w") as file:
        for i, j in pairs:
            file.write(f"{i}\t{j}\t{len(poses)}\n")
            np.savetxt(file, np.linalg.inv(poses[i]) @ poses[j])
