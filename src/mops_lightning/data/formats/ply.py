"""PLY files: ascii and binary are read, binary is written."""

import re
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.cloud_file import BinaryCloudFile
from mops_lightning.data.formats.errors import BadCloudError
from mops_lightning.data.formats.table import (
    Column,
    Table,
    columns_to_rows,
    compact_coordinates,
    from_array,
    unique_names,
)

KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
TYPES = {kind: name for name, kind in KINDS.items() if not name[-1].isdigit()}

LONGEST_HEADER = 1 << 20
"""Most bytes of a header; a file that exceeds it is not PLY."""


def split_header(data: bytes) -> tuple[list[str], int] | None:
    """Return the lines of a header, and where it ends in bytes; None if it does not end.

    Args:
        data: the first bytes of a file, at least ``LONGEST_HEADER`` if it has as many.
    """
    first = re.match(rb"[^\r\n]*(\r?\n|\r)", data)
    if not first:
        return None
    end = b"\r" if first[1] == b"\r" else b"\n"
    last = re.compile(end + rb"[ \t]*end_header[ \t\r]*?" + end).search(data, 0, LONGEST_HEADER)
    if not last:
        return None
    lines = data[: last.start()].decode("latin-1").split(end.decode())
    return [line.strip() for line in lines], last.end()


def plain_header(data: bytes) -> bytes:
    """Return a PLY file with a header that trimesh reads: no comments, lines that end in LF.

    A comment may name a texture, which would be a path to any file.

    Raises:
        ValueError: the header does not end.
    """
    found = split_header(data)
    if found is None:
        raise ValueError("its header does not end")
    lines = [line for line in found[0] if line.split()[:1] not in ([], ["comment"], ["obj_info"])]
    return "\n".join([*lines, "end_header\n"]).encode() + data[found[1] :]


def read(path: Path) -> Table | None:
    """Read the vertices with all their properties; None for a mesh, which has faces as well.

    Raises:
        BadCloudError: the file ends before its last vertex.
    """
    from trimesh.exchange.ply import load_ply

    with np.errstate(all="ignore"):
        content = BytesIO(plain_header(path.read_bytes()))
        found: Any = load_ply(content, skip_materials=True)
    if "faces" in found and len(found["faces"]):
        return None
    vertex = found["metadata"]["_ply_raw"]["vertex"]
    data, declared = vertex["data"], vertex["length"]
    if isinstance(data, dict):
        data = _rows_of_ascii(data)
    if len(data) < declared:
        raise BadCloudError(
            f"{path} is broken: its header declares {declared} points, it holds {len(data)}."
        )
    return from_array(data, list(data.dtype.names), path)


def _rows_of_ascii(data: dict[str, Any]) -> NDArray[Any]:
    """Make rows of the columns ``(N, 1)`` that trimesh reads from an ascii file."""
    flat = {name: np.asarray(column) for name, column in data.items()}
    flat = {n: c[:, 0] if c.ndim == 2 and c.shape[1] == 1 else c for n, c in flat.items()}
    flat = {name: column for name, column in flat.items() if column.ndim == 1}
    rows = np.empty(len(next(iter(flat.values()))), [(n, c.dtype) for n, c in flat.items()])
    for name, column in flat.items():
        rows[name] = column
    return rows


def write(path: Path, table: Table) -> None:
    """Write binary PLY: float coordinates, or double where float would lose digits."""
    named = unique_names(table)
    columns = [
        *compact_coordinates(table).T,
        *(column.astype(_ply_kind(column)) for column in named.values()),
    ]
    rows = columns_to_rows(columns)
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    for name, column in zip(["x", "y", "z", *named], columns, strict=True):
        lines.append(f"property {TYPES[column.dtype.str[1:]]} {name}")
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + rows.tobytes())


def _ply_kind(column: Column) -> str:
    """Return the data type that holds a column: PLY has no integers of 64 bits."""
    kind, size = column.dtype.kind, column.dtype.itemsize
    if kind in "iu" and size == 8:
        small = len(column) == 0 or (column.min() >= -(2**31) and column.max() < 2**31)
        return "<i4" if small else "<f8"
    if kind == "f":
        return f"<f{min(max(size, 4), 8)}"
    return "<u1" if kind == "b" else column.dtype.newbyteorder("<").str


def locate(path: Path) -> BinaryCloudFile:
    """Find the vertices of a binary PLY file.

    Raises:
        BadCloudError: the file is broken, a mesh, or its vertices are not rows of fixed length.
    """
    lines, offset = _header(path)
    words = [line for line in lines if line and line[0] not in ("ply", "comment", "obj_info")]
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}
    form, *elements = words or [["format", "missing"]]
    begin = [place for place, line in enumerate(elements) if line[0] == "element"]
    if form[:1] != ["format"] or form[1] not in order or begin[:1] != [0]:
        raise BadCloudError(f"{path}: --chunk needs binary PLY with a complete header.")
    first, *others = (elements[start] for start in begin)
    if first[1] != "vertex":
        raise BadCloudError(f"{path}: --chunk needs PLY whose vertices come before other elements.")
    if any(other[1] == "face" and other[2] != "0" for other in others):
        raise BadCloudError(f"{path} is a mesh: --chunk needs a cloud.")
    fields = elements[1 : begin[1] if others else None]
    if any(field[1] not in KINDS for field in fields):
        raise BadCloudError(f"{path}: --chunk needs vertices without lists.")
    kind = np.dtype([(name, order[form[1]] + KINDS[typed]) for _, typed, name in fields])
    return BinaryCloudFile(path=path, number=int(first[2]), kind=kind, offset=offset)


def _header(path: Path) -> tuple[list[list[str]], int]:
    """Return the words of the header's lines, and where the header ends, in bytes."""
    with path.open("rb") as file:
        found = split_header(file.read(LONGEST_HEADER))
    if found is None:
        raise BadCloudError(f"{path} is broken: its header does not end.")
    return [line.split() for line in found[0]], found[1]
