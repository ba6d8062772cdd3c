#!/usr/bin/env bash
# trimesh 5.2.0 reads normalised integer positions of a GLB file (KHR_mesh_quantization) as they are:
# a triangle from 10 to 14 comes out from 10 to 131078, without an error or a warning.
# Expected by the glTF 2.0 extension: an int16 of 32767 is 1.0, before the node's scale of 4.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet trimesh==5.2.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import io
import json
import struct

import numpy as np
import trimesh

corners = np.array([[0, 0, 0, 0], [32767, 0, 0, 0], [0, 32767, 0, 0]], "<i2").tobytes()
buffer = corners + np.array([0, 1, 2, 0], "<u2").tobytes()
tree = {
    "asset": {"version": "2.0"},
    "extensionsUsed": ["KHR_mesh_quantization"],
    "extensionsRequired": ["KHR_mesh_quantization"],
    "scene": 0,
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0, "scale": [4, 4, 4], "translation": [10, 20, 30]}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    "accessors": [
        {
            "bufferView": 0,
            "componentType": 5122,
            "normalized": True,
            "count": 3,
            "type": "VEC3",
            "min": [0, 0, 0],
            "max": [32767, 32767, 0],
        },
        {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
    ],
    "bufferViews": [
        {"buffer": 0, "byteOffset": 0, "byteLength": 24, "byteStride": 8, "target": 34962},
        {"buffer": 0, "byteOffset": 24, "byteLength": 6, "target": 34963},
    ],
    "buffers": [{"byteLength": 32}],
}
text = json.dumps(tree).encode()
text += b" " * (-len(text) % 4)
body = struct.pack("<I", len(text)) + b"JSON" + text
body += struct.pack("<I", len(buffer)) + b"BIN\0" + buffer
content = b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body

scene = trimesh.load(io.BytesIO(content), file_type="glb", force="scene")
low, high = scene.bounds
print("trimesh", trimesh.__version__, "low", low, "high", high)
assert not np.allclose(high, [14, 24, 30], atol=1e-3), "trimesh now scales the positions"
PYTHON
