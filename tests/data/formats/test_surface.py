"""What sampled points of a mesh take from its vertices and faces, and packed GLB files."""

import json
import struct

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning.data.formats.registry import read
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents
from tests.support.meshes import packed_glb, quantised_glb

HEAD = """\
ply
format {form} 1.0
element camera 1
property float f
element vertex 4
property double X
property double Y
property double Z
property float heat
property uchar red
property int part
{more}element face 2
property ushort zone
property list uchar int vertex_indices
end_header
"""

CORNERS = [
    (0, 0, 0),
    (1, 0, 0),
    (1, 1, 0),
    (0, 1, 0),
]


VERTICES = [
    (0, 0, 0, 0, 0, 0),
    (1, 0, 0, 1, 0, 1),
    (1, 1, 0, 1, 100, 2),
    (0, 1, 0, 0, 100, 3),
]
"""Corners with heat, which is x, red, which is 100 y, and their rows."""


FACES = [
    (5, 3, 0, 1, 2),
    (6, 4, 0, 1, 2, 3),
]
"""Zones, numbers of corners, and corners."""


def square(path, is_ascii):
    """Write a unit square of a triangle and a quad over it."""
    if is_ascii:
        lines = ["1.5"]
        for row in (*VERTICES, *FACES):
            lines.append(" ".join(map(str, row)))
        path.write_text(HEAD.format(form="ascii", more="") + "\n".join(lines) + "\n")
        return
    head = HEAD.format(form="binary_little_endian", more="")
    content = head.encode() + struct.pack("<f", 1.5)
    for vertex in VERTICES:
        content += struct.pack("<3dfBi", *vertex)
    for face in FACES:
        number = face[1]
        content += struct.pack(f"<HB{number}i", *face)
    path.write_bytes(content)


@pytest.mark.parametrize("is_ascii", [True, False])
def test_ply_of_triangle_and_quad_is_sampled_with_its_numbers(is_ascii, tmp_path):
    path = tmp_path / "a.ply"
    square(path, is_ascii)

    table = read(path, 2000, 0)

    x, y, _ = table.points.T
    red = table.columns["red"]
    part = table.columns["part"]
    zone = table.columns["zone"]
    assert_allclose(table.columns["heat"], x, atol=1e-6)
    assert_array_equal(red, np.rint(100 * y))
    assert red.dtype == np.uint8
    to_corners = np.abs(table.points[:, None] - CORNERS).sum(2)
    is_near = to_corners.min(1) < 0.3
    nearest_corner = to_corners.argmin(1)
    assert_array_equal(part[is_near], nearest_corner[is_near])
    only_quad = y > x
    assert set(zone[only_quad]) == {6}
    assert set(zone) == {5, 6}
    assert table.form.left_out == ("element camera",)


@pytest.mark.parametrize("is_ascii", [True, False])
def test_ply_vertices_of_a_mesh_are_all_its_rows(is_ascii, tmp_path):
    square(tmp_path / "a.ply", is_ascii)

    table = read(tmp_path / "a.ply", 9, 0, vertices=True)

    assert table.points.tolist() == [list(corner) for corner in CORNERS]
    assert table.columns["part"].tolist() == [0, 1, 2, 3]
    assert table.form.left_out == ("element camera", "element face")


def test_ply_with_lists_of_different_lengths_is_read(tmp_path):
    path = tmp_path / "a.ply"
    head = """\
ply
format binary_big_endian 1.0
element chunks 2
property list uint short items
element point 2
property float x
property float y
property float z
property list uchar int seen
property uchar red
end_header
"""
    content = head.encode()
    content += struct.pack(">Ihh", 2, 7, 8)
    content += struct.pack(">I", 0)
    content += struct.pack(">fffBiB", 1, 2, 3, 1, 9, 50)
    content += struct.pack(">fffBiiB", 4, 5, 6, 2, 8, 7, 60)
    path.write_bytes(content)

    table = contents(path)

    assert table.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert table.columns["red"].tolist() == [50, 60]
    assert table.form.left_out == ("seen", "element chunks")


def normals_of(table):
    columns = table.columns
    return np.column_stack([columns["nx"], columns["ny"], columns["nz"]])


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_normals_and_colours_of_vertices_reach_sampled_points(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    ball = trimesh.creation.icosphere(subdivisions=4)
    height = ball.vertices[:, 2] + 1
    colours = np.full((len(height), 4), 255, np.uint8)
    colours[:, 0] = np.rint(127 * height)
    ball.visual.vertex_colors = colours
    options = {} if suffix == ".ply" else {"include_normals": True}
    assert ball.vertex_normals is not None  # so that it is exported
    ball.export(path, **options)

    table = read(path, 500, 0)

    normals = normals_of(table)
    lengths = np.linalg.norm(normals, axis=1)
    assert_allclose(lengths, 1, atol=1e-6)
    assert_allclose(normals, table.points, atol=0.01)  # those of faces differ by 0.03
    red = table.columns["red"].astype(float)
    expected_red = 127 * (table.points[:, 2] + 1)
    assert_allclose(red, expected_red, atol=3)


def test_glb_normals_follow_an_uneven_scale(tmp_path):
    path = tmp_path / "a.glb"
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(subdivisions=4)
    assert ball.vertex_normals is not None
    scene.add_geometry(ball, transform=np.diag([1, 2, 3, 1]))
    path.write_bytes(scene.export(file_type="glb", include_normals=True))

    table = read(path, 500, 0)

    gradients = table.points / [1, 4, 9]
    lengths = np.linalg.norm(gradients, axis=1, keepdims=True)
    assert_allclose(normals_of(table), gradients / lengths, atol=0.02)


@pytest.mark.parametrize("sparse", [False, True])
def test_quantised_and_sparse_glb_has_its_corners(sparse, tmp_path):
    (tmp_path / "a.glb").write_bytes(quantised_glb(sparse))

    table = read(tmp_path / "a.glb", 9, 0, vertices=True)

    assert table.points.tolist() == [[10, 20, 30], [14, 20, 30], [10, 24, 30]]


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression"])
def test_glb_that_needs_an_extension_is_refused_by_its_name(name, tmp_path):
    content = quantised_glb()
    length = struct.unpack_from("<I", content, 12)[0]
    tree = json.loads(content[20 : 20 + length])
    tree["extensionsRequired"].append(name)
    (tmp_path / "a.glb").write_bytes(packed_glb(tree, content[28 + length :]))

    with pytest.raises(UserError, match=rf"a\.glb.*needs the glTF extension {name}"):
        contents(tmp_path / "a.glb")


def test_colours_that_a_part_of_a_scene_lacks_are_named(tmp_path):
    path = tmp_path / "a.glb"
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.visual.vertex_colors = np.full((len(ball.vertices), 4), 9, np.uint8)
    box = trimesh.creation.box()
    scene = trimesh.Scene([ball, box])
    path.write_bytes(scene.export(file_type="glb"))

    table = contents(path)

    assert table.form.left_out == ("red", "green", "blue", "alpha")


def test_colours_of_faces_reach_the_points_on_them(tmp_path):
    path = tmp_path / "a.ply"
    more = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    axes = "property float x\nproperty float y\nproperty float z\n"
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 4\n{axes}element face 2\n"
        f"property list uchar int vertex_indices\n{more}end_header\n"
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2 9 0 7\n3 0 2 3 200 0 7\n"
    )

    table = read(path, 200, 0)

    x, y, _ = table.points.T
    assert_array_equal(table.columns["red"][x > y], 9)
    assert_array_equal(table.columns["red"][x < y], 200)
    assert set(table.columns["blue"]) == {7}


def test_normals_of_length_zero_stay_zero(tmp_path):
    path = tmp_path / "a.ply"
    axes = "property float x\nproperty float y\nproperty float z\n"
    normals = "property float nx\nproperty float ny\nproperty float nz\n"
    rows = "0 0 0 0 0 0\n1 0 0 0 0 0\n0 1 0 0 0 0\n3 0 1 2\n"
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 3\n{axes}{normals}element face 1\n"
        f"property list uchar int vertex_indices\nend_header\n{rows}"
    )

    table = read(path, 20, 0)

    assert_array_equal(normals_of(table), np.zeros((20, 3)))


@pytest.mark.parametrize(
    ("name", "content", "lost"),
    [
        (
            "a.off",
            "COFF\n3 1 0\n0 0 0 9 9 9 255\n1 0 0 9 9 9 255\n0 1 0 9 9 9 255\n3 0 1 2\n",
            "colours",
        ),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 9 0 7\n# end\n", "colours"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 9\n", "colours"),
        ("a.obj", "usemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "materials"),
    ],
)
def test_colours_and_materials_that_are_not_read_are_named(name, content, lost, tmp_path):
    path = tmp_path / name
    path.write_text(content)

    assert contents(path).form.left_out == (lost,)


def test_interleaved_int8_positions_and_normals_of_glb(tmp_path):
    """Positions stand for themselves, normals for shares of 127; -128 is -1, too."""
    path = tmp_path / "a.glb"
    rows = np.array(
        [
            [0, 0, 5, 0, 0, 0, 127, 0],
            [100, 0, 5, 0, 0, 0, -127, 0],
            [0, -100, 5, 0, -128, 0, 0, 0],
        ],
        "i1",
    )
    triangle = np.array([0, 1, 2, 0], "<u2")
    buffer = rows.tobytes() + triangle.tobytes()
    positions = {"bufferView": 0, "componentType": 5120, "count": 3, "type": "VEC3"}
    normals = {**positions, "byteOffset": 4, "normalized": True}
    indices = {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}
    attributes = {"POSITION": 0, "NORMAL": 1}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 2}]}],
        "accessors": [positions, normals, indices],
        "bufferViews": [
            {"buffer": 0, "byteLength": 24, "byteStride": 8},
            {"buffer": 0, "byteOffset": 24, "byteLength": 6},
        ],
        "buffers": [{"byteLength": len(buffer)}],
    }
    path.write_bytes(packed_glb(tree, buffer))

    table = read(path, 9, 0, vertices=True)

    assert table.points.tolist() == [[0, 0, 5], [100, 0, 5], [0, -100, 5]]
    assert normals_of(table).tolist() == [[0, 0, 1], [0, 0, -1], [-1, 0, 0]]
