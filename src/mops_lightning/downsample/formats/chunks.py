"""Clouds in files that need not fit in memory: any stretch of their points can be read alone."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mops_lightning.downsample.formats.las import check_bounds, laspy_for, table_of
from mops_lightning.downsample.formats.table import (
    BadCloudError,
    Table,
    column_names,
    ends_early,
    from_array,
    naming,
)

PLY_KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip

LONGEST_LINE, MOST_LINES = 4096, 1000
"""What a head of PLY may hold; beyond, the file is something else."""


@dataclass(frozen=True)
class CloudFile:
    """Where the points of a file lie in it.

    Attributes:
        path: the file.
        number: how many points it has, those included that are not finite.
        kind: one point's bytes, with the names of the columns; None: laspy knows.
        offset: of the first point, in bytes.
        head: see ``Table``; the tables that are read have none.
    """

    path: Path
    number: int
    kind: np.dtype[Any] | None
    offset: int = 0
    head: Any = None

    def row_ranges(self, size: int) -> list[range]:
        """Cut the rows into row_ranges of up to ``size``."""
        starts = range(0, self.number, size)
        return [range(start, min(start + size, self.number)) for start in starts]

    def read(self, rows: range) -> Table:
        """Read a stretch of rows, without the points that are not finite.

        Raises:
            BadCloudError: the file is broken, or gone.
        """
        with naming(self.path):
            return self.raw(rows).finite()

    def raw(self, rows: range) -> Table:
        """Read a stretch of rows with all its points; the format's own errors pass through.

        Raises:
            BadCloudError: the file ends too early.
        """
        if self.kind is None:
            with laspy_for(self.path).open(self.path) as file:
                file.seek(rows.start)
                table = table_of(file.read_points(len(rows)), None)
                check_bounds(self.path, table, file.header)
        else:
            start = self.offset + rows.start * self.kind.itemsize
            array = np.fromfile(self.path, self.kind, len(rows), offset=start)
            table = from_array(array, list(self.kind.names or ()), self.path)
        if len(table.points) < len(rows):
            raise ends_early(self.path, rows.start + len(table.points))
        return table


def stored(path: Path) -> CloudFile:
    """Find out where the points of a file lie.

    Raises:
        BadCloudError: the file is broken, or of a format that is read as a whole only.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise BadCloudError(f"{path}: --chunk works with {', '.join(FORMATS)}.")
    if not path.is_file():
        raise BadCloudError(f"{path}: no such file.")
    with naming(path):
        return FORMATS[suffix](path)


def _npy(path: Path) -> CloudFile:
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    names, kind = column_names(array, path), array.dtype
    if kind.names is None:
        if not array.flags.c_contiguous:
            raise BadCloudError(f"{path}: --chunk needs an array in C order, not in Fortran's.")
        kind = np.dtype([(name, kind) for name in names])
    return CloudFile(path, array.shape[0], kind, array.offset)


def kitti(path: Path) -> CloudFile:
    """Find the rows of one of KITTI's scans: float32 x, y, z, intensity.

    Raises:
        BadCloudError: the file is no such scan.
    """
    length = path.stat().st_size
    if not length or length % 16:
        raise BadCloudError(f"{path} is no KITTI scan: {length} bytes are no rows of four floats.")
    kind = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])
    return CloudFile(path, length // 16, kind)


def _ply(path: Path) -> CloudFile:
    with path.open("rb") as file:
        lines: list[list[str]] = []
        while (line := file.readline(LONGEST_LINE)).split() != [b"end_header"]:
            if not line or len(lines) == MOST_LINES:
                raise BadCloudError(f"{path} is broken: its head does not end.")
            lines.append(line.decode("latin-1").split())
        offset = file.tell()
    words = [line for line in lines if line and line[0] not in ("ply", "comment", "obj_info")]
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}
    form, *elements = words or [["format", "of no kind"]]
    begin = [place for place, line in enumerate(elements) if line[0] == "element"]
    if form[:1] != ["format"] or form[1] not in order or begin[:1] != [0]:
        raise BadCloudError(f"{path}: --chunk needs binary PLY with a complete head.")
    first, *others = (elements[start] for start in begin)
    if first[1] != "vertex":
        raise BadCloudError(f"{path}: --chunk needs PLY whose vertices come before other elements.")
    if any(other[1] == "face" and other[2] != "0" for other in others):
        raise BadCloudError(f"{path} is a mesh: --chunk is for clouds.")
    fields = elements[1 : begin[1] if others else None]
    if any(field[1] not in PLY_KINDS for field in fields):
        raise BadCloudError(f"{path}: --chunk needs vertices without lists.")
    kind = np.dtype([(name, order[form[1]] + PLY_KINDS[typed]) for _, typed, name in fields])
    return CloudFile(path, int(first[2]), kind, offset)


def _las(path: Path) -> CloudFile:
    with laspy_for(path).open(path) as file:
        return CloudFile(path, file.header.point_count, None, head=file.header)


FORMATS: dict[str, Callable[[Path], CloudFile]] = {
    ".npy": _npy,
    ".bin": kitti,
    ".ply": _ply,
    ".las": _las,
    ".laz": _las,
}
