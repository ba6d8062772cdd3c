"""Binary glTF files: extensions, types of numbers, sparse accessors and textures."""

import json
import struct

import numpy as np
import pytest

from mops_lightning.data.formats.registry import read
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents
from tests.support.meshes import packed_glb, quantised_glb


@pytest.mark.parametrize(
    "name",
    ["KHR_texture_transform", "EXT_texture_webp", "KHR_materials_unlit", "KHR_lights_punctual"],
)
def test_glb_that_needs_an_extension_of_its_looks_is_read(name, tmp_path):
    content = quantised_glb()
    length = struct.unpack_from("<I", content, 12)[0]
    tree = json.loads(content[20 : 20 + length])
    tree["extensionsRequired"].append(name)
    (tmp_path / "a.glb").write_bytes(packed_glb(tree, content[28 + length :]))

    table = read(tmp_path / "a.glb", 9, 0, vertices=True)

    assert table.points.tolist() == [[10, 20, 30], [14, 20, 30], [10, 24, 30]]


COMPONENTS = {
    5120: ("i1", -100),
    5121: ("u1", 200),
    5122: ("<i2", -30_000),
    5123: ("<u2", 60_000),
    5125: ("<u4", 2**31 + 2**10),
    5126: ("<f4", 0.25),
}
"""Data types of accessors, and a number that no smaller type holds."""


def glb_of_triangle(kind, numbers, buffer_of_views=0, **more):
    """Return a triangle whose positions are numbers ``(3, 3)`` of a type behind four bytes."""
    corners = np.array(numbers, COMPONENTS[kind][0]).tobytes()
    corners += bytes(-len(corners) % 4)
    triangle = np.array([0, 1, 2, 0], "<u2").tobytes()
    buffer = bytes(4) + corners + triangle
    positions = {
        "bufferView": 0,
        "byteOffset": 4,
        "componentType": kind,
        "count": 3,
        "type": "VEC3",
        **more,
    }
    indices = {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}
    end = len(corners) + 4
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [positions, indices],
        "bufferViews": [
            {"buffer": buffer_of_views, "byteOffset": 0, "byteLength": end},
            {"buffer": 0, "byteOffset": end, "byteLength": 6},
        ],
        "buffers": [{"byteLength": len(buffer)}],
    }
    return packed_glb(tree, buffer)


@pytest.mark.parametrize("kind", COMPONENTS)
def test_glb_positions_of_every_type_are_read(kind, tmp_path):
    _, number = COMPONENTS[kind]
    corners = [[number, 0, 1], [0, 1, 0], [1, 0, 0]]
    (tmp_path / "a.glb").write_bytes(glb_of_triangle(kind, corners))

    table = read(tmp_path / "a.glb", 9, 0, vertices=True)

    assert table.points.tolist() == corners


def test_glb_sparse_numbers_begin_at_their_offsets(tmp_path):
    corners = [[1, 2, 3], [4, 5, 6], [-7, 8, 100]]
    places = {"bufferView": 0, "byteOffset": 5, "componentType": 5121}
    values = {"bufferView": 0, "byteOffset": 10}
    sparse = {"count": 1, "indices": places, "values": values}
    (tmp_path / "a.glb").write_bytes(glb_of_triangle(5120, corners, sparse=sparse))

    table = read(tmp_path / "a.glb", 9, 0, vertices=True)

    # The byte at 5 is 2, the row; those at 10 are the third corner's.
    assert table.points.tolist() == corners


def test_glb_textures_are_named_as_left_out(tmp_path):
    content = glb_of_triangle(5126, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    length = struct.unpack_from("<I", content, 12)[0]
    tree = json.loads(content[20 : 20 + length])
    tree["textures"] = [{}]
    (tmp_path / "a.glb").write_bytes(packed_glb(tree, content[28 + length :]))

    assert contents(tmp_path / "a.glb").form.left_out == ("textures",)


def test_glb_of_several_buffers_is_broken(tmp_path):
    corners = [[1, 2, 3], [4, 5, 6], [-7, 8, 100]]
    (tmp_path / "a.glb").write_bytes(glb_of_triangle(5120, corners, buffer_of_views=1))

    with pytest.raises(UserError, match=r"a\.glb is broken: .*it has several buffers"):
        contents(tmp_path / "a.glb")
