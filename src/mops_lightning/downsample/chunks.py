"""Clouds in files that need not fit in memory, so many points at a time."""

import re
from collections.abc import Callable, Iterator
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


def chunks_of(path: Path, size: int) -> Iterator[Table]:
    """Yield the points of a file in tables of up to ``size``, without those that are not finite.

    Raises:
        BadCloudError: the file is broken, or of a format that is read as a whole only.
    """
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise BadCloudError(f"{path}: --chunk works with {', '.join(READERS)}.")
    if not path.is_file():
        raise BadCloudError(f"{path}: no such file.")
    try:
        for table in READERS[suffix](path, size):
            finite = np.isfinite(table.points).all(axis=1)
            yield table if finite.all() else table.take(np.flatnonzero(finite))
    except (OSError, ValueError, KeyError) as error:
        raise BadCloudError(f"{path} is broken: {type(error).__name__}: {error}.") from None


def _npy(path: Path, size: int) -> Iterator[Table]:
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        head = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        shape, fortran, kind = head(file)
        if kind.names:
            yield from _rows(file, path, kind, list(kind.names), shape[0], size)
            return
        names = column_names(shape, kind.kind, path)
        if fortran:
            raise BadCloudError(f"{path}: --chunk needs an array in C order, not in Fortran's.")
        rows = np.dtype([(name, kind) for name in names])
        yield from _rows(file, path, rows, names, shape[0], size)


def bin_chunks(path: Path, size: int) -> Iterator[Table]:
    """Yield KITTI's scans, float32 x, y, z, intensity, in tables of up to ``size`` points.

    Raises:
        BadCloudError: the file is no such scan.
    """
    names = ["x", "y", "z", "intensity"]
    length = path.stat().st_size
    if not length or length % 16:
        raise BadCloudError(f"{path} is no KITTI scan: {length} bytes are no rows of four floats.")
    with path.open("rb") as file:
        kind = np.dtype([(name, "<f4") for name in names])
        yield from _rows(file, path, kind, names, length // 16, size)


def _ply(path: Path, size: int) -> Iterator[Table]:
    with path.open("rb") as file:
        head = b""
        while not head.endswith(b"end_header\n") and len(head) < 65536:
            line = file.readline()
            if not line:
                break
            head += line.replace(b"\r\n", b"\n")
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
        yield from _rows(file, path, kind, list(kind.names or ()), int(first[1]), size)


def _las(path: Path, size: int) -> Iterator[Table]:
    with laspy_for(path).open(path) as file:
        for points in file.chunk_iterator(size):
            yield table_of(points, file.header)


def _rows(
    file: Any, path: Path, kind: np.dtype[Any], names: list[str], number: int, size: int
) -> Iterator[Table]:
    for start in range(0, number, size):
        wanted = min(size, number - start)
        array = np.fromfile(file, kind, wanted)
        if len(array) < wanted:
            raise BadCloudError(f"{path} is broken: it ends after {start + len(array)} points.")
        yield from_array(array, names, path)


READERS: dict[str, Callable[[Path, int], Iterator[Table]]] = {
    ".npy": _npy,
    ".bin": bin_chunks,
    ".ply": _ply,
    ".las": _las,
    ".laz": _las,
}
