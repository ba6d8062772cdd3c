"""PLY files."""

import struct

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.registry import open_cloud_file, read
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents, write_cloud
from tests.support.clouds import normal_points


def test_ply_ascii_cloud_and_binary_mesh_are_read(tmp_path):
    path = tmp_path / "a.ply"
    rows = "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 2\n{rows}end_header\n1 2 3 9\n4 5 6 8\n"
    )
    table = contents(path)
    assert_array_equal(table.points, [[1, 2, 3], [4, 5, 6]])
    assert_array_equal(table.columns["red"], [9, 8])
    trimesh.creation.icosphere().export(tmp_path / "ball.ply")
    surface = read(tmp_path / "ball.ply", 500, 0)
    assert surface.points.shape == (500, 3)
    outwards = np.stack([surface.columns[name] for name in ("nx", "ny", "nz")], 1)
    assert ((outwards * surface.points).sum(1) > 0.9).all()


HEADS = {
    "comment between": ("property float z", "comment made by hand\nproperty float z"),
    "obj_info between": ("property float z", "obj_info num_cols 4\nproperty float z"),
    "blanks and tabs": ("property float z", "property \t float   z \t"),
    "element in a comment": ("element vertex", "comment one element per scan\nelement vertex"),
    "line ends of Windows": ("\n", "\r\n"),
}


@pytest.mark.parametrize("kind", HEADS)
def test_ply_header_variant_is_read(kind, tmp_path):
    path = tmp_path / "a.ply"
    points = normal_points(50, 1).astype(np.float32).astype(float)
    red = np.arange(50, dtype=np.uint8)
    write_cloud(path, points, {"red": red})
    head, end, rows = path.read_bytes().partition(b"end_header\n")
    usual, variant = HEADS[kind]
    changed = (head + end).decode().replace(usual, variant)
    path.write_bytes(changed.encode() + rows)

    table = open_cloud_file(path).read(range(10, 50))

    assert_array_equal(table.points, points[10:])
    assert_array_equal(table.columns["red"], red[10:])


def test_ply_vertices_with_lists_are_rejected(tmp_path):
    path = tmp_path / "a.ply"
    axes = "property float x\nproperty float y\nproperty float z\n"
    head = f"element vertex 1\n{axes}property list uchar int seen\n"
    path.write_text(f"ply\nformat binary_little_endian 1.0\n{head}end_header\n")
    with pytest.raises(UserError, match="without lists"):
        open_cloud_file(path)


def test_ply_chunked_impossible_count_is_broken(tmp_path):
    path = tmp_path / "a.ply"
    write_cloud(path, np.ones((5, 3)))
    path.write_bytes(path.read_bytes().replace(b"vertex 5", b"vertex 999999999999"))
    with pytest.raises(UserError, match="ends after 5 points"):
        open_cloud_file(path)


def two_rows(form, end):
    """Return the rows (1, 2, 3) and (4, 5, 10) of a PLY file."""
    if form == "ascii":
        return f"1 2 3{end}4 5 10{end}".encode()
    order = ">" if form == "binary_big_endian" else "<"
    return struct.pack(f"{order}6f", 1, 2, 3, 4, 5, 10)  # 10 is the byte of a line end


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_line_ends_and_latin_comments_are_read(end, form, tmp_path):
    path = tmp_path / "a.ply"
    lines = [
        "ply",
        "comment größe",
        f"format {form} 1.0",
        "comment é",
        "element vertex 2",
        "property float x",
        "property float y",
        "property float z",
        "end_header",
        "",
    ]
    head = end.join(lines).encode("latin-1")
    path.write_bytes(head + two_rows(form, end))

    points = contents(path).points

    assert points.tolist() == [[1, 2, 3], [4, 5, 10]]
    if form != "ascii":
        rows = open_cloud_file(path).read(range(2))
        assert rows.points.tolist() == [[1, 2, 3], [4, 5, 10]]


def test_ply_texture_comment_opens_no_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    trimesh.creation.box().export(path)
    content = path.read_bytes().replace(b"ply\n", b"ply\ncomment TextureFile /etc/passwd\n", 1)
    path.write_bytes(content.replace(b"comment TextureFile", b"comment  TextureFile"))
    opened = []
    monkeypatch.setattr("PIL.Image.open", lambda *a: opened.append(a))
    assert len(contents(path).points) == 9
    assert not opened
