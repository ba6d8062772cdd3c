"""Text files of scanners: .pts with counted points, .ptx with a grid and a pose per scan."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.columns import common_names
from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.table import Column, Form, Table
from mops_lightning.data.formats.text import numbers_of_lines

PTS_COLUMNS = {
    3: (),
    4: ("intensity",),
    6: ("red", "green", "blue"),
    7: ("intensity", "red", "green", "blue"),
    10: ("intensity", "red", "green", "blue", "nx", "ny", "nz"),
}
"""Columns after x, y and z, by the number of words in a line."""

PTX_HEADER = 10
"""Lines before the points of a scan: two numbers, a position, three axes, a matrix."""


def read_pts(path: Path) -> Table:
    """Read points, of which one or several blocks begin with their number.

    Raises:
        BadCloudError: the file has no points, or fewer than it announces.
    """
    lines = _lines(path)
    counts = [int(line) for line in lines if line.isdecimal()]
    rows = [line for line in lines if not line.isdecimal()]
    if not rows:
        raise BadCloudError(f"{path} holds no points.")
    announced = sum(counts)
    if counts and announced != len(rows):
        raise BadCloudError(
            f"{path} is broken: it announces {announced} points, but has {len(rows)}."
        )
    values = numbers_of_lines(rows, None)
    if len(values) not in PTS_COLUMNS:
        raise BadCloudError(
            f"{path} must have x y z, intensity and red green blue, got {len(values)} numbers in "
            "a line."
        )
    points = np.stack(values[:3], 1).astype(np.float64)
    names = PTS_COLUMNS[len(values)]
    columns = dict(zip(names, values[3:], strict=True))
    form = Form(np.dtype(np.float64))
    return Table(points, columns, form=form)


def read_ptx(path: Path) -> Table:
    """Read the scans of a file at their poses; cells without a return get NaN as coordinates.

    A column ``scan`` has the number of the scan where there are several.

    Raises:
        BadCloudError: the file is broken or ends before its last point.
    """
    lines = _lines(path)
    points: list[NDArray[np.float64]] = []
    columns: list[dict[str, Column]] = []
    start = 0
    while start < len(lines):
        head = lines[start : start + PTX_HEADER]
        if len(head) < PTX_HEADER:
            raise BadCloudError(f"{path} is broken: it ends in the header of a scan.")
        width = int(head[0])
        height = int(head[1])
        number = width * height
        matrix = np.array([line.split() for line in head[6:]], np.float64)
        first = start + PTX_HEADER
        body = lines[first : first + max(number, 0)]
        if number < 1 or len(body) < number:
            raise BadCloudError(
                f"{path} is broken: it announces {number} points, but has {len(body)}."
            )
        values = numbers_of_lines(body, None)
        if len(values) not in (4, 7) or matrix.shape != (4, 4):
            raise BadCloudError(
                f"{path} is broken: a point has x y z, intensity and perhaps red green blue, got "
                f"{len(values)} numbers."
            )
        seen = np.stack(values[:3], 1).astype(np.float64)
        points.append(_posed(seen, matrix))
        names_of_scan = PTS_COLUMNS[len(values)]
        columns.append(dict(zip(names_of_scan, values[3:], strict=True)))
        start = first + number
    if not points:
        raise BadCloudError(f"{path} is empty.")
    names = common_names(columns)
    joined = {name: np.concatenate([scan[name] for scan in columns]) for name in names}
    if len(points) > 1:
        lengths = [len(scan) for scan in points]
        numbers = np.arange(len(points), dtype=np.uint16)
        joined["scan"] = np.repeat(numbers, lengths)
    known = {name for scan in columns for name in scan}
    left_out = sorted(known.difference(names))
    form = Form(np.dtype(np.float64), left_out=tuple(left_out))
    return Table(np.concatenate(points), joined, form=form)


def _lines(path: Path) -> list[str]:
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    lines = [line.strip() for line in text.splitlines()]
    return [line for line in lines if line]


def _posed(points: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points in the frame of the project; the matrix multiplies rows ``(x, y, z, 1)``."""
    empty = (points == 0).all(axis=1)
    rotation = matrix[:3, :3]
    translation = matrix[3, :3]
    posed = points @ rotation + translation
    posed[empty] = np.nan
    return posed
