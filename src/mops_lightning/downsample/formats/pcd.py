"""PCD files of the Point Cloud Library, version 0.7: ascii, binary and binary_compressed."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.downsample.formats.table import (
    BadCloudError,
    Table,
    coordinates,
    from_array,
    unique_names,
)

KINDS = {"F": "f", "I": "i", "U": "u"}
HEAD = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS")


def read(path: Path) -> Table:
    """Read a PCD file; fields with a COUNT above 1 are left out."""
    data = path.read_bytes()
    head, start = _head(data, path)
    try:
        names, sizes = head["FIELDS"], [int(size) for size in head["SIZE"]]
        counts = [int(count) for count in head.get("COUNT", ["1"] * len(names))]
        number = int(head.get("POINTS", [head["WIDTH"][0]])[0])
        kinds = [f"<{KINDS[kind]}{size}" for kind, size in zip(head["TYPE"], sizes, strict=True)]
        fields = [
            (name if name != "_" else f"_{place}", kind, (count,))
            for place, (name, kind, count) in enumerate(zip(names, kinds, counts, strict=True))
        ]
        layout = np.dtype(fields)
        array = _body(data[start:], head["DATA"][0], layout, number)
    except (KeyError, ValueError, IndexError) as error:
        raise BadCloudError(f"{path} is broken: {type(error).__name__}: {error}.") from None
    single = [
        field
        for field, (_, _, count) in zip(layout.names or (), fields, strict=True)
        if count == (1,) and not field.startswith("_")
    ]
    flat = np.empty(number, [(name, layout[name].base) for name in single])
    for name in single:
        flat[name] = array[name][:, 0]
    return from_array(flat, single, path)


def write(path: Path, table: Table) -> None:
    """Write a binary PCD file: coordinates as float32, or double where that would lose digits."""
    arrays = dict(zip("xyz", coordinates(table).T, strict=True)) | unique_names(table)
    kinds = {"f": "F", "i": "I", "u": "U", "b": "U"}
    fields = [(name, a.dtype.newbyteorder("<").str) for name, a in arrays.items()]
    array = np.empty(len(table.points), fields)
    for name, values in arrays.items():
        array[name] = values
    types = [kinds[a.dtype.kind] for a in arrays.values()]
    rows = {
        "VERSION": ["0.7"],
        "FIELDS": list(arrays),
        "SIZE": [str(a.dtype.itemsize) for a in arrays.values()],
        "TYPE": types,
        "COUNT": ["1"] * len(arrays),
        "WIDTH": [str(len(array))],
        "HEIGHT": ["1"],
        "VIEWPOINT": ["0", "0", "0", "1", "0", "0", "0"],
        "POINTS": [str(len(array))],
    }
    lines = [f"{name} {' '.join(rows[name])}" for name in HEAD]
    text = "\n".join(["# .PCD v0.7 - Point Cloud Data file format", *lines, "DATA binary\n"])
    path.write_bytes(text.encode() + array.tobytes())


def _head(data: bytes, path: Path) -> tuple[dict[str, list[str]], int]:
    head: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in head:
        end = data.find(b"\n", start)
        if end < 0 or start > 65536:
            raise BadCloudError(f"{path} is broken: its head has no DATA line.")
        words = data[start:end].decode("latin-1").split()
        if words and not words[0].startswith("#"):
            head[words[0].upper()] = words[1:]
        start = end + 1
    return head, start


def _body(body: bytes, kind: str, layout: np.dtype[Any], number: int) -> NDArray[Any]:
    if kind == "ascii":
        numbers = np.array(body.split(), dtype=np.float64).reshape(number, -1)
        array, place = np.empty(number, layout), 0
        for name in layout.names or ():
            width = layout[name].shape[0]
            array[name] = numbers[:, place : place + width]
            place += width
        return array
    if kind == "binary":
        return np.frombuffer(body, layout, number)
    if kind != "binary_compressed":
        raise ValueError(f"DATA {kind} is not ascii, binary or binary_compressed")
    packed, whole = np.frombuffer(body, "<u4", 2)
    unpacked = unpack_lzf(body[8 : 8 + int(packed)], int(whole))
    array, place = np.empty(number, layout), 0
    for name in layout.names or ():  # field after field, not point after point
        size = layout[name].itemsize * number
        column = np.frombuffer(unpacked[place : place + size], layout[name].base)
        array[name] = column.reshape(number, *layout[name].shape)
        place += size
    return array


def unpack_lzf(data: bytes, size: int) -> bytes:
    """Undo the LZF compression of Marc Lehmann's liblzf.

    Raises:
        ValueError: the data do not give ``size`` bytes.
    """
    out = bytearray()
    place = 0
    while place < len(data):
        control = data[place]
        place += 1
        if control < 32:  # so many bytes, and one more, as they are
            out += data[place : place + control + 1]
            place += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[place]
            place += 1
        start = len(out) - ((control & 31) << 8) - data[place] - 1
        place += 1
        length += 2
        if start < 0:
            raise ValueError("compressed data refer to what is not there")
        while length:  # what is copied may be what the copy itself has made
            piece = out[start : start + length]
            out += piece
            start += len(piece)
            length -= len(piece)
    if len(out) != size:
        raise ValueError(f"compressed data give {len(out)} bytes instead of {size}")
    return bytes(out)
