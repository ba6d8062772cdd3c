"""Elements of PLY files: which one has the points, its types of numbers, and what is left out."""

import struct

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.ply import parse_mesh
from mops_lightning.data.formats.registry import open_cloud_file, read
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents

AXES = "property float x\nproperty float y\nproperty float z\n"


def head(form, *elements):
    lines = "".join(elements)
    return f"ply\nformat {form} 1.0\n{lines}end_header\n"


TYPES = {
    "char": ("b", -100),
    "int8": ("b", -100),
    "uchar": ("B", 200),
    "uint8": ("B", 200),
    "short": ("h", -30_000),
    "int16": ("h", -30_000),
    "ushort": ("H", 60_000),
    "uint16": ("H", 60_000),
    "int": ("i", -2_000_000_000),
    "int32": ("i", -2_000_000_000),
    "uint": ("I", 4_000_000_000),
    "uint32": ("I", 4_000_000_000),
    "float": ("f", 0.25),
    "float32": ("f", 0.25),
    "double": ("d", 0.1),
    "float64": ("d", 0.1),
}
"""Letters of struct, and a number that no smaller type holds."""


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("name", TYPES)
def test_every_type_of_number_is_read(name, form, tmp_path):
    path = tmp_path / "a.ply"
    letter, number = TYPES[name]
    text = head(form, "element vertex 1\n", AXES, f"property {name} value\n")
    row = f"1 2 3 {number}\n".encode()
    if form != "ascii":
        order = ">" if "big" in form else "<"
        row = struct.pack(f"{order}fff{letter}", 1, 2, 3, number)
    path.write_bytes(text.encode() + row)

    table = contents(path)

    assert table.points.tolist() == [[1, 2, 3]]
    value = table.columns["value"]
    assert value.tolist() == [number]
    assert value.dtype == np.dtype(letter)
    assert value.dtype.isnative


def test_ascii_number_that_its_type_does_not_hold_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    text = head("ascii", "element vertex 1\n", AXES, "property uchar red\n")
    path.write_text(f"{text}1 2 3 0.5\n")

    with pytest.raises(UserError, match="red has numbers that are no uint8"):
        contents(path)


TWO_CLOUDS = ("element sensor 2\n", AXES, "element vertex 3\n", AXES)
"""Two sensors before three vertices."""


def write_two_clouds(path, form):
    rows = np.arange(15, dtype="<f4").reshape(5, 3)
    content = rows.tobytes()
    if form == "ascii":
        content = "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode()
    path.write_bytes(head(form, *TWO_CLOUDS).encode() + content)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_points_are_the_vertices_also_behind_another_element_with_axes(form, tmp_path):
    path = tmp_path / "a.ply"
    write_two_clouds(path, form)

    table = contents(path)

    assert table.points.tolist() == [[6, 7, 8], [9, 10, 11], [12, 13, 14]]
    assert table.form.left_out == ("element sensor",)


def test_ranges_of_rows_begin_behind_the_elements_before(tmp_path):
    path = tmp_path / "a.ply"
    write_two_clouds(path, "binary_little_endian")

    rows = open_cloud_file(path).read(range(1, 3))

    assert rows.points.tolist() == [[9, 10, 11], [12, 13, 14]]


FACES = "element face {}\nproperty list uchar int vertex_indices\n"


def test_file_of_no_faces_is_a_cloud_of_its_vertices(tmp_path):
    path = tmp_path / "a.ply"
    text = head("ascii", "element vertex 2\n", AXES, FACES.format(0))
    path.write_text(f"{text}1 2 3\n4 5 6\n")

    table = contents(path)

    assert table.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert table.form.left_out == ()


def test_corners_of_faces_are_their_indices_and_not_the_first_list(tmp_path):
    """A triangle with texture coordinates before its corners, as Blender and MeshLab may write."""
    path = tmp_path / "a.ply"
    lists = "property list uchar float texcoord\nproperty list uchar int vertex_index\n"
    text = head("ascii", "element vertex 3\n", AXES, "element face 1\n", lists)
    path.write_text(f"{text}0 0 7\n1 0 7\n0 1 7\n6 0 0 1 0 0 1 3 0 1 2\n")

    table = read(path, 50, 0)

    assert_array_equal(table.points[:, 2], np.full(50, 7.0))
    assert table.points[:, :2].sum(1).max() <= 1
    assert_array_equal(table.columns["nz"], np.ones(50))


COUNTS = ["char", "uchar", "short", "ushort", "int", "uint"]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("count", COUNTS)
def test_polygons_of_any_number_of_corners_are_cut_into_triangles(count, form, tmp_path):
    """A pentagon and a triangle over it, whose lists differ in length."""
    path = tmp_path / "a.ply"
    corners = [(0, 0, 0), (4, 0, 0), (4, 2, 0), (2, 4, 0), (0, 4, 0)]
    faces = [(5, 0, 1, 2, 3, 4), (3, 0, 1, 2)]
    lists = f"element face 2\nproperty list {count} int vertex_indices\n"
    text = head(form, "element vertex 5\n", AXES, lists)
    if form == "ascii":
        rows = [" ".join(map(str, row)) for row in (*corners, *faces)]
        content = "\n".join(rows).encode()
    else:
        order = ">" if "big" in form else "<"
        content = b"".join(struct.pack(f"{order}3f", *corner) for corner in corners)
        letter, _ = TYPES[count]
        for face in faces:
            content += struct.pack(f"{order}{letter}{face[0]}i", *face)
    path.write_bytes(text.encode() + content)

    mesh = parse_mesh(path.read_bytes(), path)

    expected = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 1, 2]]
    assert mesh.faces.tolist() == expected
    assert mesh.table.points.tolist() == [list(corner) for corner in corners]


@pytest.mark.parametrize("count", ["char", "short", "int"])
def test_list_of_fewer_than_no_corners_is_broken(count, tmp_path):
    path = tmp_path / "a.ply"
    lists = f"element face 2\nproperty list {count} uchar vertex_indices\n"
    text = head("binary_little_endian", "element vertex 3\n", AXES, lists)
    letter, _ = TYPES[count]
    content = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
    content += struct.pack(f"<{letter}3B", 3, 0, 1, 2)
    content += struct.pack(f"<{letter}", -1) + bytes(70_000)
    path.write_bytes(text.encode() + content)

    with pytest.raises(ValueError, match="says 2 rows of face, it has 1"):
        parse_mesh(path.read_bytes(), path)


def test_ascii_rows_that_are_missing_are_counted_in_their_element(tmp_path):
    path = tmp_path / "a.ply"
    text = head("ascii", *TWO_CLOUDS)
    path.write_text(text + "0 0 0\n" * 4)

    with pytest.raises(UserError, match="says 3 rows of vertex, it has 2"):
        contents(path)


def test_elements_without_rows_or_points_are_not_named(tmp_path):
    path = tmp_path / "a.ply"
    plane = "element plane 2\nproperty float x\nproperty float y\n"
    lists = "element lists 1\n" + "".join(f"property list uchar int {axis}\n" for axis in "xyz")
    empty = "element empty 0\nproperty float w\n"
    text = head("ascii", plane, lists, empty, "element point 1\n", AXES)
    path.write_text(f"{text}1 2\n3 4\n1 7 1 8 1 9\n4 5 6\n")

    table = contents(path)

    assert table.points.tolist() == [[4, 5, 6]]
    assert table.form.left_out == ("element plane", "element lists")
