"""What sampled points of a mesh take from its vertices and faces, and packed GLB files."""

import json
import struct

import numpy as np
import pytest
import trimesh

from mops_lightning.data.formats.registry import read
from mops_lightning.errors import UserError
from tests.support.meshes import packed_glb, quantised_glb

HEAD = (
    "ply\nformat {form} 1.0\nelement camera 1\nproperty float f\n"
    "element vertex 4\nproperty double X\nproperty double Y\nproperty double Z\n"
    "property float heat\nproperty uchar red\nproperty int part\n{more}"
    "element face 2\nproperty ushort zone\nproperty list uchar int vertex_indices\nend_header\n"
)

CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


def square(path, is_ascii):
    """Write a unit square of a triangle and a quad over it; heat is x, red is 100 y."""
    rows = [(*corner, corner[0], 100 * corner[1], place) for place, corner in enumerate(CORNERS)]
    faces = [(5, 3, 0, 1, 2), (6, 4, 0, 1, 2, 3)]
    if is_ascii:
        lines = ["1.5", *(" ".join(map(str, row)) for row in (*rows, *faces))]
        path.write_text(HEAD.format(form="ascii", more="") + "\n".join(lines) + "\n")
        return
    body = struct.pack("<f", 1.5)
    body += b"".join(struct.pack("<3dfBi", *row) for row in rows)
    body += b"".join(struct.pack(f"<HB{face[1]}i", *face) for face in faces)
    path.write_bytes(HEAD.format(form="binary_little_endian", more="").encode() + body)


@pytest.mark.parametrize("is_ascii", [True, False])
def test_ply_of_triangle_and_quad_is_sampled_with_its_numbers(is_ascii, tmp_path):
    square(tmp_path / "a.ply", is_ascii)

    table = read(tmp_path / "a.ply", 2000, 0)

    x, y, _ = table.points.T
    np.testing.assert_allclose(table.columns["heat"], x, atol=1e-6)
    np.testing.assert_array_equal(table.columns["red"], np.rint(100 * y))
    assert table.columns["red"].dtype == np.uint8
    corner = np.abs(table.points[:, None] - CORNERS).sum(2).argmin(1)
    near = np.sort(np.abs(table.points[:, None] - CORNERS).sum(2), 1)[:, 0] < 0.3
    np.testing.assert_array_equal(table.columns["part"][near], corner[near])
    below = y > x  # only the quad is there
    assert set(table.columns["zone"][below]) == {6}
    assert set(table.columns["zone"]) == {5, 6}
    assert table.form.left_out == ("element camera",)


@pytest.mark.parametrize("is_ascii", [True, False])
def test_ply_vertices_of_a_mesh_are_all_its_rows(is_ascii, tmp_path):
    square(tmp_path / "a.ply", is_ascii)

    table = read(tmp_path / "a.ply", 9, 0, vertices=True)

    assert table.points.tolist() == [list(corner) for corner in CORNERS]
    assert table.columns["part"].tolist() == [0, 1, 2, 3]
    assert table.form.left_out == ("element camera", "element face")


def test_ply_with_lists_of_different_lengths_is_read(tmp_path):
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = (
        f"ply\nformat binary_big_endian 1.0\nelement chunks 2\nproperty list uint short items\n"
        f"element point 2\n{axes}property list uchar int seen\nproperty uchar red\nend_header\n"
    )
    chunks = struct.pack(">Ihh", 2, 7, 8) + struct.pack(">I", 0)
    rows = struct.pack(">fffBiB", 1, 2, 3, 1, 9, 50) + struct.pack(">fffBiiB", 4, 5, 6, 2, 8, 7, 60)
    (tmp_path / "a.ply").write_bytes(head.encode() + chunks + rows)

    table = read(tmp_path / "a.ply", 9, 0)

    assert table.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert table.columns["red"].tolist() == [50, 60]
    assert table.form.left_out == ("seen", "element chunks")


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_normals_and_colours_of_vertices_reach_sampled_points(suffix, tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=4)
    colours = np.full((len(ball.vertices), 4), 255, np.uint8)
    colours[:, 0] = np.rint(127 * (ball.vertices[:, 2] + 1))
    ball.visual.vertex_colors = colours
    options = {} if suffix == ".ply" else {"include_normals": True}
    assert ball.vertex_normals is not None  # so that it is exported
    ball.export(tmp_path / f"a{suffix}", **options)

    table = read(tmp_path / f"a{suffix}", 500, 0)

    normals = np.stack([table.columns[name] for name in ("nx", "ny", "nz")], 1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(normals, table.points, atol=0.01)  # those of faces differ by 0.03
    expected = 127 * (table.points[:, 2] + 1)
    np.testing.assert_allclose(table.columns["red"].astype(float), expected, atol=3)


def test_glb_normals_follow_an_uneven_scale(tmp_path):
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(subdivisions=4)
    assert ball.vertex_normals is not None
    scene.add_geometry(ball, transform=np.diag([1, 2, 3, 1]))
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb", include_normals=True))

    table = read(tmp_path / "a.glb", 500, 0)

    normals = np.stack([table.columns[name] for name in ("nx", "ny", "nz")], 1)
    expected = table.points / [1, 4, 9]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(normals, expected, atol=0.02)


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
        read(tmp_path / "a.glb", 9, 0)


def test_colours_that_a_part_of_a_scene_lacks_are_named(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.visual.vertex_colors = np.full((len(ball.vertices), 4), 9, np.uint8)
    scene = trimesh.Scene([ball, trimesh.creation.box()])
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))

    table = read(tmp_path / "a.glb", 9, 0)

    assert table.form.left_out == ("red", "green", "blue", "alpha")
