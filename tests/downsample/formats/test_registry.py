"""Every format: what is written is read again, by others too, and bad files are named."""

from typing import Any

import laspy
import numpy as np
import pytest
import trimesh

from mops_lightning.downsample.formats import pcd
from mops_lightning.downsample.formats.registry import WRITERS, read
from mops_lightning.downsample.formats.table import Table
from mops_lightning.errors import UserError


@pytest.fixture
def table():
    random = np.random.default_rng(0)
    points = random.normal(size=(50, 3)).astype(np.float32).astype(np.float64)
    columns: dict[str, np.ndarray] = {
        "red": random.integers(0, 255, 50).astype(np.uint8),
        "intensity": random.random(50).astype(np.float32),
        "label": random.integers(-5, 5, 50),
    }
    return Table(points, columns)


def written(table, suffix, tmp_path):
    path = tmp_path / f"cloud{suffix}"
    WRITERS[suffix](path, table)
    return path


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npz", ".txt", ".xyz"])
def test_points_and_columns_come_back(table, suffix, tmp_path):
    again = read(written(table, suffix, tmp_path), 100, 0)
    np.testing.assert_allclose(again.points, table.points, rtol=1e-7, atol=1e-9)
    assert list(again.columns) == list(table.columns)
    for name, column in table.columns.items():
        np.testing.assert_allclose(again.columns[name], column, rtol=1e-6)


@pytest.mark.parametrize("suffix", [".npy", ".bin", ".obj", ".las", ".laz"])
def test_points_come_back(table, suffix, tmp_path):
    again = read(written(table, suffix, tmp_path), 100, 0)
    np.testing.assert_allclose(again.points, table.points, atol=1e-6)
    if suffix == ".bin":
        np.testing.assert_array_equal(again.columns["intensity"], table.columns["intensity"])


def test_coordinates_far_from_the_origin_keep_their_digits(tmp_path):
    points = np.random.default_rng(0).random((20, 3)) + np.array([4.5e5, 5.4e6, 100])
    for suffix in (".ply", ".npy", ".npz", ".las"):
        again = read(written(Table(points), suffix, tmp_path), 100, 0)
        np.testing.assert_allclose(again.points, points, rtol=0, atol=1e-6)


def test_other_programs_read_what_is_written(table, tmp_path):
    cloud: Any = trimesh.load(written(table, ".ply", tmp_path))
    np.testing.assert_allclose(cloud.vertices, table.points, atol=1e-6)
    las = laspy.read(written(table, ".laz", tmp_path))
    np.testing.assert_allclose(np.stack([las.x, las.y, las.z], 1), table.points, atol=1e-6)
    np.testing.assert_array_equal(las["label"], table.columns["label"])


AWKWARD = {
    "x": np.arange(4),
    "my col": np.arange(4) + 0.5,
    "my_col": np.arange(4) * 3,
    "id": np.arange(4) + 2**40,
    "swapped": np.arange(4).astype(">u2") + 300,
    "flag": np.array([True, False, True, True]),
    "classification": np.array([-1, 1000, 2, 3]),
    "intensity": np.linspace(0, 1, 4),
    "time": 3e8 + np.arange(4) * 1e-4,
}


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npz", ".txt", ".las"])
def test_awkward_columns_keep_their_numbers(suffix, tmp_path):
    points = np.random.default_rng(0).random((4, 3)) + np.array([1e6, 0, 0])
    again = read(written(Table(points, AWKWARD), suffix, tmp_path), 9, 0)
    np.testing.assert_allclose(again.points, points, rtol=0, atol=1e-6)
    columns = [c for c in again.columns.values() if c.any()]
    for name, column in AWKWARD.items():
        assert any(np.array_equal(found, column) for found in columns), name


def test_what_float32_would_move_is_not_written_as_float32(tmp_path):
    points = np.random.default_rng(0).random((20, 3)) + 1e9
    for suffix in (".pcd", ".obj", ".xyz"):
        again = read(written(Table(points), suffix, tmp_path), 9, 0)
        np.testing.assert_allclose(again.points, points, rtol=0, atol=1e-6)
    with pytest.raises(UserError, match="holds float32"):
        written(Table(points), ".bin", tmp_path)


def test_texts_dates_and_lists_are_left_out(tmp_path):
    rows = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("n", "U3"), ("d", "M8[s]")])
    np.save(tmp_path / "a.npy", rows)
    assert not read(tmp_path / "a.npy", 9, 0).columns
    np.savez(tmp_path / "a.npz", points=np.ones((3, 3)), names=np.array(["a", "b", "c"]))
    assert not read(tmp_path / "a.npz", 9, 0).columns
    head = "property float x\nproperty float y\nproperty float z\nproperty list uchar int l\n"
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 2\n{head}end_header\n"
    row = np.array([1, 2, 3], "<f4").tobytes() + b"\x01\x05\0\0\0"
    (tmp_path / "a.ply").write_bytes(head.encode() + row * 2)
    table = read(tmp_path / "a.ply", 9, 0)
    np.testing.assert_array_equal(table.take(np.array([0])).points, [[1, 2, 3]])


def test_faces_behind_a_tab_make_a_mesh(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf\t1 2 3\n")
    assert len(read(tmp_path / "a.obj", 70, 0).points) == 70


def test_a_las_file_keeps_its_kind_scale_and_dimensions(tmp_path):
    cloud = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    cloud.header.offsets, cloud.header.scales = [1000] * 3, [0.01] * 3
    cloud.x, cloud.y, cloud.z = np.random.default_rng(0).uniform(1000, 1001, (3, 30))
    cloud.intensity = np.arange(30)
    cloud.write(tmp_path / "a.las")
    table = read(tmp_path / "a.las", 100, 0)
    WRITERS[".las"](tmp_path / "b.las", table.take(np.array([3, 5])))
    again = laspy.read(tmp_path / "b.las")
    assert again.header.point_format.id == 6
    assert list(again.intensity) == [3, 5]
    np.testing.assert_array_equal(again.header.scales, [0.01] * 3)


def packed(data):
    """Compress by LZF, a plain twin of what PCL writes: the longest match within 8 KiB."""
    out, literal, place = bytearray(), bytearray(), 0

    def flush():
        for start in range(0, len(literal), 32):
            piece = literal[start : start + 32]
            out.append(len(piece) - 1)
            out.extend(piece)
        literal.clear()

    while place < len(data):
        best, where = 0, 0
        for start in range(max(0, place - 8191), place):
            length = 0
            while length < 264 and place + length < len(data):
                if data[start + length] != data[place + length]:
                    break
                length += 1
            if length > best:
                best, where = length, start
        if best < 3:
            literal.append(data[place])
            place += 1
            continue
        flush()
        back = place - where - 1
        code = best - 2
        out.append((min(code, 7) << 5) | (back >> 8))
        if code >= 7:
            out.append(code - 7)
        out.append(back & 255)
        place += best
    flush()
    return bytes(out)


HEAD = (
    "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 40\nHEIGHT 1\nPOINTS 40\n"
)


def test_pcd_in_all_its_three_forms(tmp_path):
    random = np.random.default_rng(1)
    points = random.integers(0, 3, (40, 3)).astype("<f4")
    colour = np.repeat(np.arange(4, dtype="<u4"), 10)
    rows = np.empty(40, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    rows["x"], rows["y"], rows["z"], rows["rgb"] = *points.T, colour
    fields = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in ["x", "y", "z", "rgb"])
    small = packed(fields)
    assert len(small) < len(fields)
    sizes = np.array([len(small), len(fields)], "<u4").tobytes()
    text = "\n".join(" ".join(str(value) for value in row) for row in rows.tolist())
    bodies = {"ascii": text.encode(), "binary": rows.tobytes(), "binary_compressed": sizes + small}
    for kind, body in bodies.items():
        path = tmp_path / f"{kind}.pcd"
        path.write_bytes(f"# comment\nVERSION .7\n{HEAD}DATA {kind}\n".encode() + body)
        table = pcd.read(path)
        np.testing.assert_array_equal(table.points, points)
        np.testing.assert_array_equal(table.columns["rgb"], colour)


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3\n4 5 6\n",
        "1,2,3\n4,5,6\n",
        "x;y;z\n1;2;3\n4;5;6\n",
        "# a\n// b\n1\t2\t3\n4 5 6",
        "\ufeff1 2 3\n4 5 6\n",
        "1 2 3 # first\n4 5 6 # second\n",
        "I X Y Z\n9 1 2 3\n9 4 5 6\n",
        "//Z;X;Y\n3;1;2\n6;4;5\n",
        "2\n1 2 3\n4 5 6\n",
        "a b c\n1 2 3\n4 5 6\n",
    ],
)
def test_text_in_the_usual_dialects(text, tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(read(path, 9, 0).points, [[1, 2, 3], [4, 5, 6]])


ASCII = (
    "ply\nformat ascii 1.0\nelement vertex 2\n"
    "property float x\nproperty float y\nproperty float z\nend_header\n"
)


def test_ascii_ply_and_a_mesh(tmp_path):
    path = tmp_path / "a.ply"
    rows = "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 2\n{rows}end_header\n1 2 3 9\n4 5 6 8\n"
    )
    table = read(path, 9, 0)
    np.testing.assert_array_equal(table.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(table.columns["red"], [9, 8])
    trimesh.creation.icosphere().export(tmp_path / "ball.ply")
    surface = read(tmp_path / "ball.ply", 500, 0)
    assert surface.points.shape == (500, 3)
    outwards = np.stack([surface.columns[name] for name in ("nx", "ny", "nz")], 1)
    assert ((outwards * surface.points).sum(1) > 0.9).all()


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.xyz", b"", "a.xyz is empty"),
        ("a.xyz", b"1 2 3\n4 5\n", "a.xyz is broken"),
        ("a.txt", b"1 2\n3 4\n", "rows of x, y, z"),
        ("a.npy", b"no", "a.npy is broken"),
        ("a.bin", b"12345678" * 3, "not a KITTI scan"),
        ("a.txt", b"1 2 abc\n3 4 5\n", "a.txt is broken"),
        ("a.ply", ASCII.encode() + b"1 2 3\n", "declares 2 points"),
        ("a.pcd", b"VERSION 7", "no DATA line"),
        ("a.pcd", HEAD.encode() + b"DATA binary\n123", "a.pcd is broken"),
        ("a.pcd", HEAD.encode() + b"DATA binary_compressed\n\x03\0\0\0\x80\x02\0\0123", "broken"),
        ("a.ply", b"ply\nformat", "a.ply is broken"),
        ("a.las", b"LASF", "a.las is broken"),
        ("a.off", b"OFF\n1 0 0\n0 0 0\n", "no faces"),
        ("a.jpg", b"", "must end in .ply"),
    ],
)  # fmt: skip
def test_bad_files_are_named(name, content, said, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=said):
        read(tmp_path / name, 10, 0)
