"""Small folders of meshes."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

BOX = trimesh.creation.box((1.0, 2.0, 3.0))
BALL = trimesh.creation.icosphere(subdivisions=1)


def write_mesh(path: Path, mesh: Any, **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path, **options)
    return path


def scaled(mesh: trimesh.Trimesh, factor: float) -> trimesh.Trimesh:
    return mesh.copy().apply_scale(factor).apply_translation((7, 8, 9))


def quantised_glb(sparse=False):
    """Return one triangle of corners (10, 20, 30), (14, 20, 30) and (10, 24, 30).

    Its positions are normalised int16, which the node scales and moves; with ``sparse``, all but
    the first come from a sparse accessor.
    """
    largest = 32767
    corners = np.array(
        [
            [0, 0, 0, 0],
            [largest, 0, 0, 0],
            [0, largest, 0, 0],
        ],
        "<i2",
    )
    triangle = np.array([0, 1, 2, 0], "<u2")
    buffer = corners.tobytes() + triangle.tobytes()
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": 24, "byteStride": 8},
        {"buffer": 0, "byteOffset": 24, "byteLength": 6},
    ]
    positions: dict[str, Any] = {
        "componentType": 5122,
        "normalized": True,
        "count": 3,
        "type": "VEC3",
    }
    if sparse:
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": 2})
        views.append({"buffer": 0, "byteOffset": len(buffer) + 4, "byteLength": 12})
        rows = np.array([1, 2, 0, 0], "u1")
        buffer += rows.tobytes() + corners[1:, :3].tobytes()
        places = {"bufferView": 2, "componentType": 5121}
        positions["sparse"] = {"count": 2, "indices": places, "values": {"bufferView": 3}}
    else:
        positions["bufferView"] = 0
    tree = {
        "asset": {"version": "2.0"},
        "extensionsRequired": ["KHR_mesh_quantization"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "scale": [4, 4, 4], "translation": [10, 20, 30]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            positions,
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(buffer)}],
    }
    return packed_glb(tree, buffer)


def packed_glb(tree, buffer):
    """Return a GLB file of a scene and a buffer."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    parts = struct.pack("<I", len(text)) + b"JSON" + text
    parts += struct.pack("<I", len(buffer)) + b"BIN\0" + buffer
    return b"glTF" + struct.pack("<II", 2, 12 + len(parts)) + parts
