"""Binary glTF files as trimesh reads them: without quantised and sparse accessors."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.guard import BadCloudError

KINDS = {
    5120: "i1",
    5121: "u1",
    5122: "<i2",
    5123: "<u2",
    5125: "<u4",
    5126: "<f4",
}
"""Data types of accessors by their number."""

FLOAT = 5126

WIDTHS = {
    "SCALAR": 1,
    "VEC2": 2,
    "VEC3": 3,
    "VEC4": 4,
    "MAT2": 4,
    "MAT3": 9,
    "MAT4": 16,
}
"""How many numbers an item of an accessor has."""

SURFACE = ("POSITION", "NORMAL")
"""Attributes that quantisation stores as integers."""

HARMLESS = ("KHR_mesh_quantization", "KHR_texture", "EXT_texture", "KHR_materials", "KHR_lights")
"""Beginnings of the names of required extensions that are read, or do not affect the surface."""


def plain_glb(data: bytes, path: Path) -> bytes:
    """Return a GLB file with its positions and normals as float32, and without sparse accessors.

    Args:
        data: content of the file.
        path: of the file, for errors.

    Raises:
        BadCloudError: the file needs an extension that is not read.
        ValueError: its accessors are broken.
    """
    tree, buffer = _chunks(data)
    _check_extensions(tree, path)
    accessors = tree.get("accessors", [])
    quantised = _quantised(tree)
    changed = set(quantised)
    for place, accessor in enumerate(accessors):
        if "sparse" in accessor:
            changed.add(place)
    if not changed:
        return data
    extended = bytearray(buffer)
    for place in sorted(changed):
        accessor = accessors[place]
        numbers = _numbers(tree, buffer, accessor)
        if place in quantised:
            is_normalised = bool(accessor.get("normalized"))
            numbers = _dequantised(numbers, is_normalised)
        accessors[place] = _append(tree, extended, accessor, numbers)
    return _packed(tree, bytes(extended))


def _check_extensions(tree: dict[str, Any], path: Path) -> None:
    """Reject a file that needs an extension which changes its surface."""
    for name in tree.get("extensionsRequired", []):
        if not str(name).startswith(HARMLESS):
            raise BadCloudError(
                f"{path} needs the glTF extension {name}, which is not read. Write it without, "
                f"such as by npx @gltf-transform/cli copy {path.name} plain.glb"
            )


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the scene and the buffer of a file."""
    if data[:4] != b"glTF":
        raise ValueError("it does not begin with glTF")
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    if not isinstance(tree, dict):
        raise ValueError("its scene is not an object")
    return tree, data[28 + length :]


def _quantised(tree: dict[str, Any]) -> set[int]:
    """Return the accessors of positions and normals that do not hold float32."""
    found = set()
    for mesh in tree.get("meshes", []):
        for primitive in mesh.get("primitives", []):
            for name in SURFACE:
                attributes = primitive.get("attributes", {})
                place = attributes.get(name)
                if place is None:
                    continue
                accessor = tree["accessors"][place]
                if accessor["componentType"] != FLOAT:
                    found.add(place)
    return found


def _numbers(tree: dict[str, Any], buffer: bytes, accessor: dict[str, Any]) -> NDArray[Any]:
    """Return the items ``(count, width)`` of an accessor."""
    kind = np.dtype(KINDS[accessor["componentType"]])
    width = WIDTHS[accessor["type"]]
    count = accessor["count"]
    if "bufferView" in accessor:
        view = accessor["bufferView"]
        offset = accessor.get("byteOffset", 0)
        numbers = _items(tree, buffer, view, offset, kind, count, width)
    elif count * width * kind.itemsize > len(buffer):
        raise ValueError(f"an accessor without data has {count} items")
    else:
        numbers = np.zeros((count, width), kind)
    sparse = accessor.get("sparse")
    if sparse is None:
        return numbers
    places = sparse["indices"]
    values = sparse["values"]
    number = sparse["count"]
    place_kind = np.dtype(KINDS[places["componentType"]])
    view = places["bufferView"]
    offset = places.get("byteOffset", 0)
    rows = _items(tree, buffer, view, offset, place_kind, number, 1)[:, 0]
    view = values["bufferView"]
    offset = values.get("byteOffset", 0)
    numbers = numbers.copy()
    numbers[rows] = _items(tree, buffer, view, offset, kind, number, width)
    return numbers


def _items(
    tree: dict[str, Any],
    buffer: bytes,
    place: int,
    offset: int,
    kind: np.dtype[Any],
    count: int,
    width: int,
) -> NDArray[Any]:
    """Return items ``(count, width)`` of a view of the buffer."""
    view = tree["bufferViews"][place]
    if view.get("buffer", 0) != 0:
        raise ValueError("it has several buffers")
    start = view.get("byteOffset", 0) + offset
    size = kind.itemsize * width
    step = view.get("byteStride") or size
    end = start + step * (count - 1) + size
    if min(start, step, count) < 0 or end > len(buffer):
        raise ValueError("an accessor ends after the buffer")
    strides = (step, kind.itemsize)
    return np.ndarray((count, width), kind, buffer, start, strides)


def _dequantised(numbers: NDArray[Any], normalised: bool) -> NDArray[np.float32]:
    """Return what integers stand for: themselves, or shares of the largest one."""
    if not normalised or numbers.dtype.kind == "f":
        return numbers.astype(np.float32)
    largest = np.iinfo(numbers.dtype).max
    shares = np.maximum(numbers / largest, -1)
    return shares.astype(np.float32)


def _append(
    tree: dict[str, Any],
    buffer: bytearray,
    accessor: dict[str, Any],
    numbers: NDArray[Any],
) -> dict[str, Any]:
    """Append numbers to the buffer, and return their accessor."""
    buffer += bytes(-len(buffer) % 4)
    start = len(buffer)
    buffer += numbers.tobytes()
    view = {
        "buffer": 0,
        "byteOffset": start,
        "byteLength": len(buffer) - start,
    }
    tree["bufferViews"].append(view)
    left = ("sparse", "byteOffset", "min", "max")
    plain = {key: value for key, value in accessor.items() if key not in left}
    plain["bufferView"] = len(tree["bufferViews"]) - 1
    if numbers.dtype == np.float32:
        plain["componentType"] = FLOAT
        plain.pop("normalized", None)
    return plain


def _packed(tree: dict[str, Any], buffer: bytes) -> bytes:
    tree["buffers"] = [{"byteLength": len(buffer)}]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    buffer += bytes(-len(buffer) % 4)
    text_head = struct.pack("<I", len(text)) + b"JSON"
    buffer_head = struct.pack("<I", len(buffer)) + b"BIN\0"
    chunks = text_head + text + buffer_head + buffer
    head = b"glTF" + struct.pack("<II", 2, 12 + len(chunks))
    return head + chunks
