"""Files of true motions: poses as of KITTI's odometry, and pairs as in 3DMatch's ``gt.log``.

A motion is a ``(4, 4)`` float64 matrix T of a rotation R and a translation t; it maps a point p of
the source to q = R·p + t in the coordinates of the target.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mops_lightning.errors import UserError

Matrix = NDArray[np.float64]

TOLERANCE = 1e-3
"""Largest entry of RᵀR minus the identity of what is read as a rotation."""


class ScanPair(NamedTuple):
    """Positions of two scans in their list, and the motion ``(4, 4)`` from source to target."""

    source: int
    target: int
    motion: Matrix


@dataclass(frozen=True)
class PoseRules:
    """What poses need to become pairs.

    Attributes:
        calib: file with a line ``Tr:`` and the 12 numbers of KITTI's calibration; None: the poses
            are those of the scans' own coordinates.
        gap: pairs are this many scans apart; None: 1, unless ``distance`` is given.
        distance: pairs are all pairs whose poses are at most this far apart.

    Raises:
        UserError: a value is out of range, or both ways of choosing pairs are given.
    """

    calib: Path | None = None
    gap: int | None = None
    distance: float | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        if self.gap is not None and self.gap < 1:
            raise UserError(f"gap must be at least 1, got {self.gap}.")
        if self.distance is not None and not 0 < self.distance < np.inf:
            raise UserError(f"distance must be above 0 and finite, got {self.distance}.")
        if self.gap is not None and self.distance is not None:
            raise UserError(
                f"gap and distance both choose the pairs: give one, got gap={self.gap} and "
                f"distance={self.distance:g}."
            )


def read_motions(path: Path, scans: int, rules: PoseRules) -> list[ScanPair]:
    """Read a file of either layout; the number of words in its first line tells which.

    Poses have 12 numbers per line, the first three rows of a matrix Tᵢ that maps scan i to common
    coordinates, one line per scan. A pair (i, j) has the scans i and j, i < j, as source and
    target, and the motion Tⱼ⁻¹·Tᵢ. KITTI's poses are of the left camera; with its calibration C
    from laser to camera, the motion between laser scans is C⁻¹·Tⱼ⁻¹·Tᵢ·C.

    In ``gt.log``, a line ``i j n`` (n: number of scans) precedes four lines of a matrix that maps
    scan j to scan i. Here, j is the source and i the target.

    Args:
        path: the file.
        scans: number of scans.
        rules: which pairs; for poses only.

    Returns:
        The pairs, in the order of the file or of their scans.

    Raises:
        UserError: the file cannot be read, a line is wrong, or there is no pair.
    """
    lines = _lines(path, "motions")
    words = len(lines[0][1]) if lines else 0
    if words == 3:
        if rules != PoseRules():
            raise UserError(
                f"motions: {path} lists its pairs (gt.log): leave out gap, distance and calib, "
                "which are for poses."
            )
        return _read_log(path, lines, scans)
    if words != 12:
        raise UserError(
            f"motions: {path} must be a gt.log (first line 'i j n') or poses (12 numbers per "
            f"line), got {words} words in its first line."
        )
    if len(lines) != scans:
        raise UserError(
            f"motions: {path} has {len(lines)} poses, but there are {scans} scans; there must be "
            "one pose per scan, in the order of the scans' names. Choose the scans with "
            "dataset.scans='PATTERN', such as 'velodyne/*.bin'."
        )
    poses = np.stack([_matrix(row, f"motions: {path}, line {n}") for n, row in lines])
    frame = np.eye(4) if rules.calib is None else _calibration(rules.calib)
    inverse = np.linalg.inv(poses @ frame)
    chosen = _chosen(poses[:, :3, 3], rules, path)
    return [ScanPair(i, j, inverse[j] @ poses[i] @ frame) for i, j in chosen]


def _lines(path: Path, setting: str) -> list[tuple[int, list[str]]]:
    """Return numbers and words of the lines that are not empty."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{setting}: cannot read {path}: {error}.") from error
    lines = enumerate(text.splitlines(), start=1)
    return [(number, line.split()) for number, line in lines if line.strip()]


def _matrix(words: list[str], where: str) -> Matrix:
    """Return the rigid motion of 12 or 16 numbers; its rotation is made exact."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) not in (12, 16) or not np.isfinite(numbers).all():
        raise UserError(f"{where}: must have finite numbers of a 3 x 4 or 4 x 4 matrix.")
    matrix = np.eye(4)
    matrix[: len(numbers) // 4] = np.reshape(numbers, (-1, 4))
    rotation = matrix[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    bottom = np.abs(matrix[3] - (0, 0, 0, 1)).max()
    if max(error, bottom) > TOLERANCE or np.linalg.det(rotation) < 0:
        raise UserError(
            f"{where}: not a rigid motion. The left 3 x 3 part R must be a rotation within "
            f"{TOLERANCE:g} (RᵀR differs from the identity by {error:.2g}, the determinant is "
            f"{np.linalg.det(rotation):.3g}), and a fourth row must be 0 0 0 1."
        )
    left, _, right = np.linalg.svd(rotation)
    matrix[:3, :3] = left @ right  # the nearest rotation: rounding would spoil products of poses
    matrix[3] = 0, 0, 0, 1
    return matrix


def _calibration(path: Path) -> Matrix:
    for number, words in _lines(path, "calib"):
        if words[0] == "Tr:":
            return _matrix(words[1:], f"calib: {path}, line {number}")
    raise UserError(f"calib: {path} has no line 'Tr:' with 12 numbers, as KITTI's calib.txt has.")


def _chosen(places: NDArray[np.float64], rules: PoseRules, path: Path) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of poses at ``places`` (S, 3)."""
    if rules.distance is None:
        gap = rules.gap or 1
        pairs = [(i, i + gap) for i in range(len(places) - gap)]
        said = f"gap={gap}"
    else:
        found = cKDTree(places).query_pairs(rules.distance, output_type="ndarray")
        pairs = sorted((int(i), int(j)) for i, j in np.sort(found, 1))
        said = f"distance={rules.distance:g}"
    if not pairs:
        raise UserError(f"{said}: the {len(places)} poses of {path} make no such pair.")
    return pairs


def _read_log(path: Path, lines: list[tuple[int, list[str]]], scans: int) -> list[ScanPair]:
    pairs: dict[tuple[int, int], Matrix] = {}
    for start in range(0, len(lines), 5):
        (number, header), rows = lines[start], lines[start + 1 : start + 5]
        where = f"motions: {path}, line {number}"
        if len(header) != 3 or not all(word.isdecimal() for word in header):
            raise UserError(f"{where}: must be 'i j n', three whole numbers, got {header}.")
        if [len(words) for _, words in rows] != [4, 4, 4, 4]:
            raise UserError(f"{where}: must be followed by four lines of four numbers.")
        target, source, total = map(int, header)
        if total != scans:
            raise UserError(
                f"{where}: n must be the number of scans, got {total}, but there are {scans}. "
                "Choose the scans with dataset.scans='PATTERN', such as '*.ply'."
            )
        if max(source, target) >= scans or source == target or (target, source) in pairs:
            raise UserError(
                f"{where}: i and j must be two numbers of scans from 0 to {scans - 1}, each pair "
                f"once, got {target} and {source}."
            )
        matrix = _matrix([word for _, words in rows for word in words], where)
        pairs[target, source] = matrix
    return [ScanPair(source, target, matrix) for (target, source), matrix in pairs.items()]
