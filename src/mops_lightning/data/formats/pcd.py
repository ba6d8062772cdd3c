"""PCD files of the Point Cloud Library, version 0.7: ascii, binary and binary_compressed."""

import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.columns import (
    fitting_type,
    floating,
    from_columns,
    split_array,
    to_rows,
    unique_names,
)
from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.lzf import decompress
from mops_lightning.data.formats.table import Column, Table

KINDS = {"F": "f", "I": "i", "U": "u"}

TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")

SIZES = struct.Struct("<II")
"""Before compressed points: their number of bytes in the file, and after decompression."""

NO_VIEWPOINT = "0 0 0 1 0 0 0"


@dataclass(frozen=True)
class PcdForm:
    """The pose of the sensor in a PCD file: translation and quaternion, as text."""

    viewpoint: str = NO_VIEWPOINT


def read(path: Path) -> Table:
    """Read a PCD file; a field with a COUNT of k becomes k columns."""
    data = path.read_bytes()
    header, start = _header(data)
    number = _number_of_points(header)
    if number < 1:
        raise BadCloudError(f"{path} holds no points.")
    layout = _layout(header)
    form_of_data = header["DATA"][0]
    array = _body(path, data[start:], form_of_data, layout, number)
    columns: dict[str, Column] = {}
    grouped: dict[str, tuple[str, ...]] = {}
    for name in layout.names or ():
        if name.startswith("_"):
            continue  # bytes without a meaning
        values = array[name]
        of_field = split_array(name, values)
        if values.shape[1] > 1:
            grouped[name] = tuple(of_field)
        columns |= of_field
    viewpoint = " ".join(header.get("VIEWPOINT", [NO_VIEWPOINT]))
    table = from_columns(columns, path, PcdForm(viewpoint))
    form = replace(table.form, arrays=grouped)
    return replace(table, form=form)


def _number_of_points(header: dict[str, list[str]]) -> int:
    """Return the number of points; without POINTS, that of the rows and columns of the scan."""
    if "POINTS" in header:
        return int(header["POINTS"][0])
    width = int(header["WIDTH"][0])
    height = int(header.get("HEIGHT", ["1"])[0])
    return width * height


def _layout(header: dict[str, list[str]]) -> np.dtype[Any]:
    """Return the data type of a point; fields without a name get one that begins with ``_``."""
    names = header["FIELDS"]
    ones = ["1"] * len(names)
    counts = header.get("COUNT", ones)
    fields = []
    entries = zip(names, header["TYPE"], header["SIZE"], counts, strict=True)
    for number, (name, letter, size, count) in enumerate(entries):
        field = name
        if name == "_":
            field = f"_{number}"
        kind = f"<{KINDS[letter]}{int(size)}"
        fields.append((field, kind, (int(count),)))
    return np.dtype(fields)


def write(path: Path, table: Table) -> None:
    """Write a binary PCD file with the data types of the table; float16 becomes float32.

    Raises:
        CannotHoldError: a column has numbers that no data type of PCD holds.
    """
    points = table.stored_coordinates()
    points = points.astype(floating(points.dtype))
    columns: dict[str, Column] = dict(zip("xyz", points.T, strict=True))
    for name, column in unique_names(table).items():
        kind = fitting_type(name, column, TYPES, ".pcd")
        columns[name] = column.astype(kind)
    fields = _fields(columns, table)
    letters = {kind: letter for letter, kind in KINDS.items()}
    sizes = []
    types = []
    counts = []
    for names in fields.values():
        kind_of_field = columns[names[0]].dtype
        sizes.append(str(kind_of_field.itemsize))
        types.append(letters[kind_of_field.kind])
        counts.append(str(len(names)))
    form = table.form.layout
    if not isinstance(form, PcdForm):
        form = PcdForm()
    rows = to_rows(columns)
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(fields)}",
        f"SIZE {' '.join(sizes)}",
        f"TYPE {' '.join(types)}",
        f"COUNT {' '.join(counts)}",
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        f"VIEWPOINT {form.viewpoint}",
        f"POINTS {len(rows)}",
        "DATA binary\n",
    ]
    with path.open("wb") as file:
        file.write("\n".join(lines).encode())
        rows.tofile(file)


def _fields(columns: dict[str, Column], table: Table) -> dict[str, list[str]]:
    """Return the fields of a file with the columns of each: several, where they were one field."""
    names = list(columns)
    fields: dict[str, list[str]] = {}
    start = 0
    while start < len(names):
        field = names[start]
        length = 1
        for array, members in table.form.arrays.items():
            following = tuple(names[start : start + len(members)])
            is_free = array not in columns
            if following == members and is_free and _have_one_type(columns, members):
                field = array
                length = len(members)
        fields[field] = names[start : start + length]
        start += length
    return fields


def _have_one_type(columns: dict[str, Column], names: tuple[str, ...]) -> bool:
    kinds = {columns[name].dtype for name in names}
    return len(kinds) == 1


def _header(data: bytes) -> tuple[dict[str, list[str]], int]:
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = data.find(b"\n", start)
        if end < 0 or start > 65536:
            raise ValueError("its header has no DATA line")
        words = data[start:end].decode("latin-1").split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
        start = end + 1
    return header, start


def _body(path: Path, body: bytes, kind: str, layout: np.dtype[Any], number: int) -> NDArray[Any]:
    if kind == "ascii":
        if number > len(body):
            raise ValueError(f"{len(body)} bytes are not {number} points")
        return _ascii_rows(body, layout, number)
    if kind == "binary":
        return np.frombuffer(body, layout, number)
    if kind == "binary_compressed":
        return _decompressed_rows(body, layout, number)
    raise BadCloudError(f"{path} has DATA {kind}, not ascii, binary or binary_compressed.")


def _decompressed_rows(body: bytes, layout: np.dtype[Any], number: int) -> NDArray[Any]:
    """Return the rows of a compressed file, which holds one field after the other."""
    if len(body) < SIZES.size:
        raise ValueError("its compressed points end early")
    compressed, size = SIZES.unpack_from(body)
    if size != number * layout.itemsize:
        raise ValueError(f"{size} bytes are not {number} points")
    stream = body[SIZES.size : SIZES.size + compressed]
    if len(stream) < compressed:
        raise ValueError("its compressed points end early")
    values = decompress(stream, size)
    rows = np.empty(number, layout)
    start = 0
    for name in layout.names or ():
        of_field = np.frombuffer(values, layout[name], number, offset=start)
        rows[name] = of_field
        start += number * layout[name].itemsize
    return rows


def _ascii_rows(body: bytes, layout: np.dtype[Any], number: int) -> NDArray[Any]:
    """Return the rows of an ascii file; whole numbers of 64 bits keep all digits."""
    words = np.array(body.split())
    words = words.reshape(number, -1)
    rows = np.zeros(number, layout)
    place = 0
    for name in layout.names or ():
        (count,) = layout[name].shape
        kind = layout[name].base
        for column in range(count):
            text = words[:, place]
            if kind.kind == "f" or kind.itemsize < 8:
                text = text.astype(np.float64)
            rows[name][:, column] = text.astype(kind)
            place += 1
    width = words.shape[1]
    if place != width:
        raise ValueError(f"its points have {width} numbers, not {place}")
    return rows
