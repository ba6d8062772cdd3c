"""Pairs of clouds with a known motion: halves of crops, or consecutive frames."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mops_lightning.data.crops import random_crops
from mops_lightning.data.file_splits import by_number, list_files
from mops_lightning.data.formats.registry import READABLE, read
from mops_lightning.errors import UserError
from mops_lightning.files.icp.poses import read_poses
from mops_lightning.seeding import derive_seed

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """Two clouds of one place.

    Attributes:
        path: the file of the source.
        source: ``(n, 3)``.
        target: ``(k, 3)``.
        truth: ``(4, 4)`` motion from source to target.
    """

    path: Path
    source: Points
    target: Points
    truth: Points


def scans_of(folder: Path) -> list[Path]:
    """Return the files of a folder in the order of their numbers.

    Raises:
        UserError: it has no file that can be read.
    """
    names = list_files(folder, READABLE)
    in_order = sorted(names, key=lambda name: (name.parent, by_number(name)))
    return [folder / name for name in in_order]


def read_points(path: Path, seed: int, columns: Sequence[str] | None, surface: int) -> Points:
    """Return the finite points ``(N, 3)`` of a file, of a mesh so many on its surface."""
    return read(path, surface, seed, columns=columns).finite().points


def crop_pairs(
    scans: Sequence[tuple[Path, Points]],
    n_points: int,
    crops: int,
    seed: int,
) -> list[Pair]:
    """Draw crops of scans in the unit sphere, and split each at random into two halves.

    The halves share no point; their motion is the identity.

    Args:
        scans: files and their points.
        n_points: number of points of a crop.
        crops: number of crops of every scan.
        seed: of the crops and the halves.

    Raises:
        UserError: a scan has fewer points.
    """
    pairs = []
    half = n_points // 2
    for path, points in scans:
        if len(points) < n_points:
            raise UserError(
                f"{path} has {len(points):,} points, fewer than --points {n_points}. Lower "
                "--points, or remove the file."
            )
        number_of_file = zlib.crc32(path.name.encode())
        rng = np.random.default_rng(derive_seed(seed, number_of_file))
        drawn = random_crops(points, n_points, crops, "nearest", rng, path)
        for crop in drawn.points:
            radius = float(np.linalg.norm(crop, axis=1).max())
            unit = crop.astype(np.float64) / radius
            shuffled = rng.permutation(unit)
            source = shuffled[:half]
            target = shuffled[half : 2 * half]
            pairs.append(Pair(path, source, target, truth=np.eye(4)))
    return pairs


def frame_pairs(frames: Sequence[tuple[Path, Points]], poses: Path) -> list[Pair]:
    """Pair every frame with the one before it, which is the target.

    Args:
        frames: files in the order of the sequence, and their points.
        poses: file with the pose of every frame; see ``read_poses``.

    Raises:
        UserError: there are other numbers of frames and poses, or fewer than two.
    """
    known = read_poses(poses)
    if len(known) != len(frames) or len(frames) < 2:
        raise UserError(
            f"--poses: {poses} has {len(known)} poses for {len(frames)} frames. Give one pose for "
            "each file, of two files or more."
        )
    pairs = []
    for before in range(len(frames) - 1):
        after = before + 1
        _, target = frames[before]
        path, source = frames[after]
        truth = np.linalg.solve(known[before], known[after])
        pairs.append(Pair(path, source, target, truth))
    return pairs


def draw_motions(
    pairs: Sequence[Pair], number: int, angle: float, shift: float, seed: int
) -> list[list[Points]]:
    """Draw the poses from which the registration of every pair starts.

    The truth is preceded by a turn about the source's mean, about a random axis and by an angle
    that is uniform from 0 to ``angle``, and by a shift in a random direction and of a length that
    is uniform from 0 to ``shift``.

    Args:
        pairs: P pairs.
        number: of starts of every pair.
        angle: in degrees.
        shift: in the clouds' unit.
        seed: of the motions.

    Returns:
        For every pair so many poses ``(4, 4)``.
    """
    rng = np.random.default_rng(derive_seed(seed, 1))
    starts = []
    for pair in pairs:
        centre = pair.source.mean(0)
        poses = []
        for _ in range(number):
            axis, direction = rng.normal(size=(2, 3))
            turn = np.radians(angle) * rng.random() * axis / np.linalg.norm(axis)
            length = shift * rng.random()
            rotation = Rotation.from_rotvec(turn).as_matrix()
            about_centre = centre - rotation @ centre
            motion = np.eye(4)
            motion[:3, :3] = rotation
            motion[:3, 3] = about_centre + length * direction / np.linalg.norm(direction)
            poses.append(pair.truth @ motion)
        starts.append(poses)
    return starts
