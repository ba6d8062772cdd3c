"""Counts of GLB files, compared with the length of the file."""

import json
import struct

import pytest
import trimesh

from mops_lightning.data.mesh_io import BrokenMeshError, parse_mesh


def crafted(path, change):
    """Write a box whose JSON part was changed."""
    data = trimesh.Scene(trimesh.creation.box()).export(file_type="glb")
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = b"glTF" + struct.pack("<III", 2, 20 + len(text) + len(rest), len(text)) + b"JSON"
    path.write_bytes(head + text + rest)
    return path


def announce_zeros(tree):
    for accessor in tree["accessors"]:
        accessor.pop("bufferView")
        accessor["count"] = 10**9


def repeat_mesh(tree):
    node = next(node for node in tree["nodes"] if "mesh" in node)
    tree["nodes"] += [{"name": str(number), "mesh": node["mesh"]} for number in range(40_000)]
    tree["meshes"][0]["primitives"] *= 100


def share_child(tree):
    tree["nodes"].append({"children": [1]})
    tree["nodes"].append({"children": [1]})


def circle(tree):
    tree["nodes"] = [{"children": [1], "mesh": 0}, {"children": [0], "mesh": 0}]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (announce_zeros, "values announced"),
        (repeat_mesh, "values announced"),
        (share_child, "two parents"),
        (circle, "circle"),
    ],
)
def test_glb_crafted_is_broken(change, said, tmp_path):
    path = crafted(tmp_path / "a.glb", change)
    with pytest.raises(BrokenMeshError, match=said):
        parse_mesh(path.read_bytes(), path)


def test_glb_texture_of_another_file_is_not_opened(tmp_path):
    path = crafted(tmp_path / "a.glb", lambda tree: tree.update(images=[{"uri": "/etc/passwd"}]))
    assert len(parse_mesh(path.read_bytes(), path).faces) == 12


def test_glb_buffer_of_another_file_is_broken(tmp_path):
    (tmp_path / "b.bin").write_bytes(bytes(9))
    other = {"uri": "b.bin", "byteLength": 9}
    path = crafted(tmp_path / "a.glb", lambda tree: tree["buffers"].append(other))
    with pytest.raises(BrokenMeshError, match=r"a\.glb is broken"):
        parse_mesh(path.read_bytes(), path)
