"""What holds for every format: what is written is read again, and bad files are named."""

import os
from typing import Any

import laspy
import numpy as np
import pytest
import trimesh

from mops_lightning.data.formats.registry import WRITERS, open_cloud_file, read, write
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from tests.support.full_disk import full_disk


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
def test_points_and_columns_round_trip(table, suffix, tmp_path):
    again = read(written(table, suffix, tmp_path), 100, 0)
    np.testing.assert_allclose(again.points, table.points, rtol=1e-7, atol=1e-9)
    assert list(again.columns) == list(table.columns)
    for name, column in table.columns.items():
        np.testing.assert_allclose(again.columns[name], column, rtol=1e-6)


@pytest.mark.parametrize("suffix", [".npy", ".bin", ".las", ".laz"])
def test_points_round_trip(table, suffix, tmp_path):
    again = read(written(table, suffix, tmp_path), 100, 0)
    np.testing.assert_allclose(again.points, table.points, atol=1e-6)
    if suffix == ".bin":
        np.testing.assert_array_equal(again.columns["intensity"], table.columns["intensity"])


def test_written_files_open_in_other_libraries(table, tmp_path):
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
def test_awkward_columns_keep_numbers(suffix, tmp_path):
    points = np.random.default_rng(0).random((4, 3)) + np.array([1e6, 0, 0])
    again = read(written(Table(points, AWKWARD), suffix, tmp_path), 9, 0)
    np.testing.assert_allclose(again.points, points, rtol=0, atol=1e-6)
    columns = [c for c in again.columns.values() if c.any()]
    for name, column in AWKWARD.items():
        assert any(np.array_equal(found, column) for found in columns), name


def test_coordinates_far_from_origin_keep_digits(tmp_path):
    points = np.random.default_rng(0).random((20, 3)) + np.array([1e9, 5.4e6, 100])
    for suffix in (".ply", ".pcd", ".npy", ".npz", ".xyz", ".las"):
        again = read(written(Table(points), suffix, tmp_path), 100, 0)
        np.testing.assert_allclose(again.points, points, rtol=0, atol=1e-6)
    with pytest.raises(UserError, match="holds float32"):
        written(Table(points), ".bin", tmp_path)


def test_strings_dates_and_lists_are_left_out(tmp_path):
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


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".bin", ".las", ".laz"])
def test_row_range_equals_slice_of_file(suffix, tmp_path):
    points = np.random.default_rng(1).normal(size=(500, 3)).astype(np.float32).astype(float)
    path = tmp_path / f"in{suffix}"
    WRITERS[suffix](path, Table(points, {"intensity": np.arange(500, dtype=np.uint16)}))
    cloud = open_cloud_file(path)
    assert cloud.number == 500
    assert [len(rows) for rows in cloud.row_ranges(200)] == [200, 200, 100]
    whole = cloud.read(range(500))
    np.testing.assert_allclose(whole.points, points, atol=1e-6)
    for rows in (range(0, 3), range(200, 400), range(499, 500)):
        np.testing.assert_array_equal(cloud.read(rows).points, whole.points[rows.start : rows.stop])


ASCII = (
    "ply\nformat ascii 1.0\nelement vertex 2\n"
    "property float x\nproperty float y\nproperty float z\nend_header\n"
)


HEAD = (
    "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 40\nHEIGHT 1\nPOINTS 40\n"
)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.xyz", b"", "a.xyz is empty"),
        ("a.xyz", b"1 2 3\n4 5\n", "a.xyz is broken"),
        ("a.xyz", b"not a cloud\n", "holds no points"),
        ("a.txt", b"1 2\n3 4\n", "rows of x, y, z"),
        ("a.npy", b"no", "a.npy is broken"),
        ("a.bin", b"12345678" * 3, "24 bytes are not rows of 4 float32"),
        ("a.txt", b"1 2 abc\n3 4 5\n", "a.txt is broken"),
        ("a.ply", ASCII.encode() + b"1 2 3\n", "says 2 rows of vertex, it has 1"),
        ("a.pcd", b"VERSION 7", "no DATA line"),
        ("a.pcd", HEAD.encode() + b"DATA binary\n123", "a.pcd is broken"),
        ("a.ply", b"ply\nformat", "a.ply is broken"),
        ("a.ply", ASCII.replace("vertex 2", "vertex 0").encode(), "a.ply holds no points"),
        ("a.pcd", HEAD.replace("POINTS 40", "POINTS 0").encode() + b"DATA ascii\n", "no points"),
        ("a.txt", b"1000\n1 2 3\n4 5 6\n", "a.txt is broken: it announces 1000 points, but has 2"),
        ("a.las", b"LASF", "a.las is broken"),
        ("a.off", b"OFF\n1 0 0\n0 0 0\n", "no faces"),
        ("a.jpg", b"", "must end in .ply"),
    ],
)  # fmt: skip
def test_bad_file_is_named(name, content, said, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=said):
        read(tmp_path / name, 10, 0)


def test_pipe_and_endless_device_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "a.ply")
    (tmp_path / "a.bin").symlink_to("/dev/zero")
    for name in ("a.ply", "a.bin"):
        with pytest.raises(UserError, match=rf"{name}: not a file"):
            read(tmp_path / name, 9, 0)


@pytest.mark.parametrize("suffix", WRITERS)
def test_full_disk_is_one_error(suffix, tmp_path):
    random = np.random.default_rng(0).normal(size=(3000, 3))
    with pytest.raises(UserError, match=rf"write .*a{suffix} \((?!.*None)"), full_disk():
        write(tmp_path / f"a{suffix}", Table(random))
    assert not list(tmp_path.iterdir())
