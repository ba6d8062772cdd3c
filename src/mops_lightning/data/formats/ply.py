"""PLY files: ascii and binary are read, binary is written."""

import re
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from mops_lightning.data.formats import table as tables
from mops_lightning.data.formats.guard import BadCloudError, WholeOnlyError
from mops_lightning.data.formats.isolated import isolated

KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
TYPES = {kind: name for name, kind in KINDS.items() if not name[-1].isdigit()}

LONGEST_HEADER = 1 << 20
"""Most bytes of a header; a file that exceeds it is not PLY."""


def split_header(data: bytes) -> tuple[list[list[str]], int]:
    """Return the words of a header's lines, without comments, and where it ends in bytes.

    Args:
        data: the first bytes of a file, at least ``LONGEST_HEADER`` if it has as many.

    Raises:
        ValueError: the header does not end.
    """
    first = re.match(rb"[^\r\n]*(\r?\n|\r)", data)
    end = b"\r" if first and first[1] == b"\r" else b"\n"
    last = re.compile(end + rb"[ \t]*end_header[ \t\r]*?" + end).search(data, 0, LONGEST_HEADER)
    if not last:
        raise ValueError("its header does not end")
    lines = data[: last.start()].decode("latin-1").split(end.decode())
    words = [line.split() for line in lines]
    return [line for line in words if line[:1] not in ([], ["comment"], ["obj_info"])], last.end()


def plain_header(data: bytes) -> bytes:
    """Return a PLY file with a header that trimesh reads: no comments, lines that end in LF.

    A comment may name a texture, which would be a path to any file.
    """
    lines, end = split_header(data)
    return "\n".join([*map(" ".join, lines), "end_header\n"]).encode() + data[end:]


def read(path: Path) -> tables.Table | None:
    """Read the vertices with all their properties; None for a mesh, which has faces as well.

    Raises:
        BadCloudError: the file is broken or ends before its last vertex.
    """
    return isolated(_parse, path)


def _parse(path: Path) -> tables.Table | None:
    from trimesh.exchange.ply import load_ply

    with np.errstate(all="ignore"):
        content = BytesIO(plain_header(path.read_bytes()))
        found: Any = load_ply(content, skip_materials=True)
    if "faces" in found and len(found["faces"]):
        return None
    vertex = found["metadata"]["_ply_raw"]["vertex"]
    if not vertex["length"]:
        raise BadCloudError(f"{path} holds no points.")
    columns = _columns(vertex["data"])
    number, declared = len(next(iter(columns.values()))), vertex["length"]
    if number < declared:
        raise BadCloudError(f"{path} is broken: its header says {declared} points, not {number}.")
    return tables.from_columns(columns, path)


def _columns(data: Any) -> dict[str, tables.Column]:
    """Return the columns of trimesh's rows, or of its arrays ``(N, 1)`` from an ascii file."""
    if not isinstance(data, dict):
        return {name: data[name] for name in data.dtype.names}
    columns = {name: np.asarray(column) for name, column in data.items()}
    return {name: column.ravel() for name, column in columns.items() if column.size == len(column)}


def write(path: Path, table: tables.Table) -> None:
    """Write binary PLY: float coordinates, or double where float would lose digits."""
    write_parts(path, tables.TableParts.whole(table))


def write_parts(path: Path, table: tables.TableParts) -> None:
    """Write binary PLY part by part."""
    examples = tables.unique_names(tables.Table(table.corners, table.columns))
    kinds = dict.fromkeys("xyz", table.coordinates.newbyteorder("<").str)
    kinds |= {name: _ply_kind(column) for name, column in examples.items()}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {table.number}"]
    lines += [f"property {TYPES[kind[1:]]} {name}" for name, kind in kinds.items()]
    with path.open("wb") as file:
        file.write("\n".join([*lines, "end_header\n"]).encode())
        for part in table.parts:
            columns = dict(zip("xyz", part.points.T, strict=True)) | tables.unique_names(part)
            rows = {name: column.astype(kinds[name]) for name, column in columns.items()}
            file.write(tables.to_rows(rows).tobytes())


def _ply_kind(column: tables.Column) -> str:
    """Return the data type that holds a column: PLY has no integers of 64 bits."""
    kind, size = column.dtype.kind, column.dtype.itemsize
    if kind in "iu" and size == 8:
        small = len(column) == 0 or (column.min() >= -(2**31) and column.max() < 2**31)
        return "<i4" if small else "<f8"
    if kind == "f":
        return f"<f{min(max(size, 4), 8)}"
    return "<u1" if kind == "b" else column.dtype.newbyteorder("<").str


def locate(path: Path) -> tables.CloudFile:
    """Find the vertices of a binary PLY file.

    Raises:
        BadCloudError: the file is broken, a mesh, or its vertices are not rows of fixed length.
    """
    with path.open("rb") as file:
        lines, offset = split_header(file.read(LONGEST_HEADER))
    words = [line for line in lines if line[0] != "ply"]
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}
    form, *elements = words or [["format", "missing"]]
    begin = [place for place, line in enumerate(elements) if line[0] == "element"]
    if form[:1] != ["format"] or form[1] not in order or begin[:1] != [0]:
        raise WholeOnlyError(f"{path}: --chunk needs binary PLY with a complete header.")
    first, *others = (elements[start] for start in begin)
    if first[1] != "vertex":
        raise WholeOnlyError(f"{path}: --chunk needs PLY with its vertices before all else.")
    if any(other[1] == "face" and other[2] != "0" for other in others):
        raise WholeOnlyError(f"{path} is a mesh: --chunk needs a cloud.")
    fields = elements[1 : begin[1] if others else None]
    if any(field[1] not in KINDS for field in fields):
        raise WholeOnlyError(f"{path}: --chunk needs vertices without lists.")
    kind = np.dtype([(name, order[form[1]] + KINDS[typed]) for _, typed, name in fields])
    return tables.binary_file(path, int(first[2]), kind, offset)
