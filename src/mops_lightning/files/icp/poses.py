"""Files with the poses of the frames of a sequence."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mops_lightning.errors import UserError

FORMS = (
    "12 numbers a line (KITTI: the upper three rows of the pose, row by row), or 8 (TUM: time or "
    "number, x y z, quaternion x y z w)"
)


def read_poses(path: Path) -> NDArray[np.float64]:
    """Return the poses ``(F, 4, 4)`` of all frames, from the frame to the map.

    Args:
        path: a text file of one pose a line, in the form of KITTI or TUM; lines that begin with #
            are left out.

    Raises:
        UserError: the file holds something else.
    """
    lines = _lines(path)
    identity = np.eye(4)
    poses = np.tile(identity, (len(lines), 1, 1))
    for pose, (number, words) in zip(poses, lines, strict=True):
        pose[:3] = _pose(path, number, words)
    return poses


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """Return the lines that hold a pose, with their numbers."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--poses: {path} cannot be read as text: {error}.") from None
    lines = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if words and not words[0].startswith("#"):
            lines.append((number, words))
    if not lines:
        raise UserError(f"--poses: {path} has no pose. Give {FORMS}.")
    return lines


def _pose(path: Path, number: int, words: list[str]) -> NDArray[np.float64]:
    """Return the upper three rows ``(3, 4)`` of one pose."""
    try:
        values = np.array(words, np.float64)
    except ValueError:
        values = np.empty(0)
    has_length = len(values) in (8, 12)
    if not has_length or not np.isfinite(values).all():
        raise UserError(f"--poses: line {number} of {path} is no pose. Give {FORMS}.")
    if len(values) == 12:
        rows = values.reshape(3, 4)
        rotation = rows[:, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-2):
            raise UserError(f"--poses: line {number} of {path} has no rotation.")
        return rows
    translation = values[1:4]
    quaternion = values[4:]
    if not 0.9 < np.linalg.norm(quaternion) < 1.1:
        raise UserError(f"--poses: line {number} of {path} has no unit quaternion.")
    rotation = Rotation.from_quat(quaternion).as_matrix()
    return np.column_stack([rotation, translation])
