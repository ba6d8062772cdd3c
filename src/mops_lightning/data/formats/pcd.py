"""PCD files of the Point Cloud Library, version 0.7: ascii and binary."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured
from numpy.typing import NDArray

from mops_lightning.data.formats import table as tables
from mops_lightning.data.formats.guard import BadCloudError

KINDS = {"F": "f", "I": "i", "U": "u"}


def read(path: Path) -> tables.Table:
    """Read a PCD file; a field with a COUNT of k becomes k columns."""
    data = path.read_bytes()
    header, start = _header(data)
    names = header["FIELDS"]
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    number = int(header.get("POINTS", [header["WIDTH"][0]])[0])
    if number < 1:
        raise BadCloudError(f"{path} holds no points.")
    kinds = zip(header["TYPE"], header["SIZE"], counts, strict=True)
    layout = np.dtype(
        [
            (name if name != "_" else f"_{place}", f"<{KINDS[kind]}{int(size)}", (count,))
            for place, (name, (kind, size, count)) in enumerate(zip(names, kinds, strict=True))
        ]
    )
    array = _body(path, data[start:], header["DATA"][0], layout, number)
    columns: dict[str, tables.Column] = {}
    for name in layout.names or ():
        values = array[name][:, 0] if layout[name].shape == (1,) else array[name]
        columns |= {} if name.startswith("_") else tables.split_array(name, values)
    return tables.from_columns(columns, path)


def write(path: Path, table: tables.Table) -> None:
    """Write a binary PCD file: coordinates as float32, or double where that would lose digits."""
    columns = tables.to_columns(table)
    kinds = {"f": "F", "i": "I", "u": "U", "b": "U"}
    rows = tables.to_rows(columns)
    header = {
        "VERSION": "0.7",
        "FIELDS": " ".join(columns),
        "SIZE": " ".join(str(column.dtype.itemsize) for column in columns.values()),
        "TYPE": " ".join(kinds[column.dtype.kind] for column in columns.values()),
        "COUNT": " ".join("1" for _ in columns),
        "WIDTH": str(len(rows)),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(len(rows)),
        "DATA": "binary\n",
    }
    lines = [f"{name} {values}" for name, values in header.items()]
    text = "\n".join(["# .PCD v0.7 - Point Cloud Data file format", *lines])
    path.write_bytes(text.encode() + rows.tobytes())


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
        numbers = np.array(body.split(), dtype=np.float64).reshape(number, -1)
        return unstructured_to_structured(numbers, layout)
    if kind == "binary":
        return np.frombuffer(body, layout, number)
    raise BadCloudError(
        f"{path} has DATA {kind}, which is not ascii or binary. Convert it by PCL's "
        f"pcl_convert_pcd_ascii_binary {path} OUT.pcd 1."
    )
