"""Clouds in files that need not fit in memory: any stretch of their points can be read alone."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mops_lightning.downsample.las import laspy_for, table_of
from mops_lightning.downsample.table import BadCloudError, Table, column_names, from_array

PLY_KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class Stored:
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

    def stretches(self, size: int) -> list[range]:
        """Cut the rows into stretches of up to ``size``."""
        starts = range(0, self.number, size)
        return [range(start, min(start + size, self.number)) for start in starts]

    def read(self, rows: range) -> Table:
        """Read a stretch of rows, without the points that are not finite.

        Raises:
            BadCloudError: the file is broken, or gone.
        """
        try:
            table = self.raw(rows)
        except BadCloudError:
            raise
        except (OSError, ValueError, KeyError) as error:
            raise _broken(self.path, error) from None
        finite = np.isfinite(table.points).all(axis=1)
        return table if finite.all() else table.take(np.flatnonzero(finite))

    def raw(self, rows: range) -> Table:
        """Read a stretch of rows with all its points; the format's own errors pass through."""
        if self.kind is None:
            with laspy_for(self.path).open(self.path) as file:
                file.seek(rows.start)
                return table_of(file.read_points(len(rows)), None)
        start = self.offset + rows.start * self.kind.itemsize
        array = np.fromfile(self.path, self.kind, len(rows), offset=start)
        if len(array) < len(rows):
            raise BadCloudError(
                f"{self.path} is broken: it ends after {rows.start + len(array)} points."
            )
        return from_array(array, list(self.kind.names or ()), self.path)


def stored(path: Path) -> Stored:
    """Find out where the points of a file lie.

    Raises:
        BadCloudError: the file is broken, or of a format that is read as a whole only.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise BadCloudError(f"{path}: --chunk works with {', '.join(FORMATS)}.")
    if not path.is_file():
        raise BadCloudError(f"{path}: no such file.")
    try:
        return FORMATS[suffix](path)
    except BadCloudError:
        raise
    except (OSError, ValueError, KeyError) as error:
        raise _broken(path, error) from None


def _broken(path: Path, error: Exception) -> BadCloudError:
    return BadCloudError(f"{path} is broken: {type(error).__name__}: {error}.")


def _npy(path: Path) -> Stored:
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        head = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        shape, fortran, kind = head(file)
        offset = file.tell()
    if kind.names is None:
        names = column_names(shape, kind.kind, path)
        if fortran:
            raise BadCloudError(f"{path}: --chunk needs an array in C order, not in Fortran's.")
        kind = np.dtype([(name, kind) for name in names])
    return Stored(path, shape[0], kind, offset)


def kitti(path: Path) -> Stored:
    """Find the rows of one of KITTI's scans: float32 x, y, z, intensity.

    Raises:
        BadCloudError: the file is no such scan.
    """
    length = path.stat().st_size
    if not length or length % 16:
        raise BadCloudError(f"{path} is no KITTI scan: {length} bytes are no rows of four floats.")
    kind = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])
    return Stored(path, length // 16, kind)


def _ply(path: Path) -> Stored:
    with path.open("rb") as file:
        head = b""
        while not head.endswith(b"end_header\n") and len(head) < 65536:
            line = file.readline()
            if not line:
                break
            head += line.replace(b"\r\n", b"\n")
        offset = file.tell()
    text = head.decode("latin-1")
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}
    form = re.search(r"^format (\S+)", text, re.M)
    first = re.search(r"^element vertex (\d+)\n((?:property \S+ \S+\n)*)", text, re.M)
    before = text.split("element vertex")[0]
    if not form or form[1] not in order or not first or "element" in before:
        raise BadCloudError(f"{path}: --chunk needs binary PLY whose vertices come first.")
    if re.search(r"^element face [1-9]", text, re.M):
        raise BadCloudError(f"{path} is a mesh: --chunk is for clouds.")
    fields = [line.split()[1:] for line in first[2].splitlines()]
    kind = np.dtype([(name, order[form[1]] + PLY_KINDS[typed]) for typed, name in fields])
    return Stored(path, int(first[1]), kind, offset)


def _las(path: Path) -> Stored:
    with laspy_for(path).open(path) as file:
        return Stored(path, file.header.point_count, None, head=file.header)


FORMATS: dict[str, Callable[[Path], Stored]] = {
    ".npy": _npy,
    ".bin": kitti,
    ".ply": _ply,
    ".las": _las,
    ".laz": _las,
}
