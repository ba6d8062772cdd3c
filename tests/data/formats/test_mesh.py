import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning.data.formats import isolated
from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.mesh import MAX_MATERIALS, parse_mesh, sample_mesh
from tests.support.meshes import BALL, BOX, write_mesh

SQUARE = "OFF\n4 2 0\n0 0 5\n3 0 5\n3 3 5\n0 3 5\n3 0 1 2\n3 0 2 3\n"


@pytest.mark.parametrize("suffix", ["off", "obj", "ply", "stl", "glb", "ascii.ply", "ascii.stl"])
def test_parse_formats_give_same_surface(tmp_path, suffix):
    options: dict[str, Any] = {}
    if suffix == "ascii.ply":
        options = {"encoding": "ascii"}
    elif suffix == "ascii.stl":
        options = {"file_type": "stl_ascii"}
    path = write_mesh(tmp_path / f"mesh.{suffix}", BOX, **options)
    mesh = parse_mesh(path.read_bytes(), path)
    assert_allclose(mesh.bounds, BOX.bounds)
    assert_allclose(mesh.area, BOX.area)


@pytest.mark.parametrize(
    "head",
    [
        "OFF490 518 0",
        "OFF 490 518 0",
        "OFF\r\n490 518 0",
        "OFF\n# a\n490 518 0",
    ],
)
def test_parse_off_header_variants(head):
    ball = trimesh.creation.uv_sphere(count=[16, 32])
    _, _, *rows = trimesh.exchange.off.export_off(ball).splitlines()
    vertices = str(len(ball.vertices))
    faces = str(len(ball.faces))
    head = head.replace("490", vertices).replace("518", faces)
    text = "\n".join([head, *rows])

    mesh = parse_mesh(text.encode(), Path("m.off"))

    assert_allclose(mesh.vertices, ball.vertices, atol=1e-9)
    assert_array_equal(mesh.faces, ball.faces)


@pytest.mark.parametrize(
    "face", ["4 0 1 2 3", "4 0 1 2 3 255 0 0", "3 0 1 2\n3 0 2 3", "3 0 1 2 0.5 0.5 0.5\n3 0 2 3"]
)
def test_parse_off_polygons_and_colours(face):
    text = f"OFF\n4 {1 + face.count(chr(10))} 0\n0 0 5\n3 0 5\n3 3 5\n0 3 5\n{face}\n"
    assert parse_mesh(text.encode(), Path("m.off")).area == pytest.approx(9)


def test_parse_scene_applies_transforms(tmp_path):
    scene = trimesh.Scene(BOX)
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 0, 1), (5, 0, 0))
    scene.add_geometry(BOX, transform=turn)
    path = write_mesh(tmp_path / "scene.glb", scene)
    mesh = parse_mesh(path.read_bytes(), path)
    assert_allclose(mesh.area, 2 * BOX.area)
    assert_allclose(mesh.bounds, scene.bounds)
    assert mesh.bounds[1, 0] < 7


@pytest.mark.parametrize("suffix", ["off", "obj", "stl"])
def test_parse_latin1_comment(tmp_path, suffix):
    comment = "# Körper\n".encode("latin-1")
    if suffix == "stl":
        text = trimesh.exchange.stl.export_stl_ascii(BOX).encode()
        data = text.replace(b"solid", "solid Körper".encode("latin-1"), 1)
    else:
        data = comment + write_mesh(tmp_path / f"m.{suffix}", BOX).read_bytes()
    assert parse_mesh(data, Path(f"m.{suffix}")).area == pytest.approx(BOX.area)


def test_parse_obj_without_material_file():
    text = "mtllib gone.mtl\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    assert parse_mesh(text.encode(), Path("m.obj")).area == 0.5


def half(mesh, kind):
    data = mesh.export(file_type=kind)
    data = data.encode() if isinstance(data, str) else data
    return data[: len(data) // 2]


def last_faces_missing(mesh, kind):
    options = {"encoding": "ascii"} if kind == "ply" else {}
    data = mesh.export(file_type=kind, **options)
    data = data.encode() if isinstance(data, str) else data
    return b"\n".join(data.splitlines()[:-5]) + b"\n"


TRIANGLE = "v 0 0 0\nv {} 0 0\nv 0 1 0\nf 1 2 {}\n"
BROKEN = {
    "empty.off": (b"", "is empty"),
    "blank.obj": (b" \n\n", "is empty"),
    "half.off": (half(BALL, "off"), "is broken"),
    "half.ply": (half(BALL, "ply"), "is broken"),
    "half.stl": (half(BALL, "stl"), "80 triangles take 4084 bytes, not 2042"),
    "half.glb": (half(BALL, "glb"), "is broken"),
    "cut.off": (last_faces_missing(BALL, "off"), "it has 75 of 80 faces"),
    "cut.ply": (last_faces_missing(BALL, "ply"), "says 80 rows of face, it has 75"),
    "noise.off": (bytes(range(256)) * 9, "is broken"),
    "noise.obj": (bytes(range(256)) * 9, r"is broken|has no faces"),
    "noise.ply": (bytes(range(256)) * 9, "is broken"),
    "noise.stl": (bytes(range(256)) * 9, "is broken"),
    "noise.glb": (bytes(range(256)) * 9, "is broken"),
    "cloud.off": (b"OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", "has no faces"),
    "cloud.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "has no faces"),
    "line.off": (b"OFF\n3 1 0\n0 0 0\n1 1 1\n2 2 2\n3 0 1 2\n", "area zero"),
    "thin.off": (b"OFF\n3 1 0\n.1 .2 .3\n.2 .4 .6\n.3 .6 .9\n3 0 1 2\n", "area zero"),
    "long.off": (
        b"OFF\n3 1 0\n1e6 2e6 3e6\n2e6 4e6 6e6\n3.3e6 6.6e6 9.9e6\n3 0 1 2\n",
        "area zero",
    ),
    "point.off": (b"OFF\n3 1 0\n1 1 1\n1 1 1\n1 1 1\n3 0 1 2\n", "area zero"),
    "nan.obj": (TRIANGLE.format("nan", 3).encode(), "not all finite"),
    "huge.obj": (TRIANGLE.format("1e308", 3).replace("1 0", "1e308 0").encode(), "not all finite"),
    "flat.obj": (b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "is broken"),
    "outside.obj": (TRIANGLE.format(1, 9).encode(), "is broken"),
    "outside.off": (
        SQUARE.replace("0 2 3", "0 2 4").encode(),
        "face index outside the range of its vertices",
    ),
    "negative.off": (
        SQUARE.replace("3 0 2 3", "3 0 2 -1").encode(),
        "face index outside the range of its vertices",
    ),
    "mesh.dae": (b"<COLLADA/>", "must end in"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_parse_broken_mesh_raises(name):
    data, message = BROKEN[name]
    with pytest.raises(BadCloudError, match=rf"{name}.*({message})"):
        parse_mesh(data, Path(name))


FACET = """\
solid a
facet normal {normal}
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid
"""


@pytest.mark.parametrize("normal", ["nan nan nan", "a b c", "0 1", ""])
def test_ascii_stl_normals_of_the_file_are_ignored(normal):
    text = FACET.format(normal=normal)

    mesh = parse_mesh(text.encode(), Path("a.stl"))

    assert_allclose(mesh.face_normals, [[0, 0, 1]])


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_small_and_large_meshes_are_not_flat(size):
    text = f"OFF\n3 1 0\n0 0 0\n{size} 0 0\n0 {size / 1000} 0\n3 0 1 2\n"

    mesh = parse_mesh(text.encode(), Path("a.off"))

    assert float(mesh.area) == pytest.approx(size**2 / 2000)


def test_obj_of_many_materials_is_read(tmp_path):
    path = tmp_path / "a.obj"
    faces = "".join(f"usemtl m{number}\nf 1 2 3\n" for number in range(MAX_MATERIALS + 1))
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{faces}")
    assert len(parse_mesh(path.read_bytes(), path).faces) == MAX_MATERIALS + 1


def crafted(path, change):
    """Write a box whose JSON part was changed."""
    box = trimesh.creation.box()
    data = trimesh.Scene(box).export(file_type="glb")
    (length,) = struct.unpack_from("<I", data, 12)
    end = 20 + length
    tree = json.loads(data[20:end])
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = data[end:]
    whole = 20 + len(text) + len(rest)
    head = b"glTF" + struct.pack("<III", 2, whole, len(text)) + b"JSON"
    path.write_bytes(head + text + rest)
    return path


def announce_zeros(tree):
    for accessor in tree["accessors"]:
        accessor.pop("bufferView")
        accessor["count"] = 10**9


def circle(tree):
    tree["nodes"] = [{"children": [1], "mesh": 0}, {"children": [0], "mesh": 0}]


@pytest.mark.parametrize("change", [announce_zeros, circle])
def test_glb_of_any_size_is_broken(change, tmp_path, monkeypatch):
    monkeypatch.setattr(isolated, "SECONDS", 5.0)
    path = crafted(tmp_path / "a.glb", change)
    with pytest.raises(BadCloudError, match=r"a\.glb is broken"):
        sample_mesh(path, path.read_bytes(), 9, 0)


def test_glb_texture_of_another_file_is_not_opened(tmp_path):
    texture = {"uri": "/etc/passwd"}
    path = crafted(tmp_path / "a.glb", lambda tree: tree.update(images=[texture]))

    mesh = parse_mesh(path.read_bytes(), path)

    assert len(mesh.faces) == 12


def test_glb_buffer_of_another_file_is_broken(tmp_path):
    (tmp_path / "b.bin").write_bytes(bytes(9))
    other = {"uri": "b.bin", "byteLength": 9}
    path = crafted(tmp_path / "a.glb", lambda tree: tree["buffers"].append(other))

    with pytest.raises(BadCloudError, match=r"a\.glb is broken"):
        parse_mesh(path.read_bytes(), path)
