"""What holds for every format: what is written is read again, and bad files are named."""

import os
import struct
from typing import Any

import laspy
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning.data.formats.registry import WRITERS, open_cloud_file, read, write
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents, write_cloud, write_table
from tests.support.clouds import normal_points, uniform_points
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
    write_table(path, table)
    return path


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npz", ".txt", ".xyz"])
def test_points_and_columns_round_trip(table, suffix, tmp_path):
    path = written(table, suffix, tmp_path)

    again = read(path, 100, 0)

    assert_allclose(again.points, table.points, rtol=1e-7, atol=1e-9)
    assert list(again.columns) == list(table.columns)
    for name, column in table.columns.items():
        assert_allclose(again.columns[name], column, rtol=1e-6)


@pytest.mark.parametrize("suffix", [".npy", ".bin", ".las", ".laz"])
def test_points_round_trip(table, suffix, tmp_path):
    again = read(written(table, suffix, tmp_path), 100, 0)
    assert_allclose(again.points, table.points, atol=1e-6)
    if suffix == ".bin":
        assert_array_equal(again.columns["intensity"], table.columns["intensity"])


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


def test_written_ply_opens_in_trimesh(table, tmp_path):
    path = written(table, ".ply", tmp_path)

    cloud: Any = trimesh.load(path)

    assert_allclose(cloud.vertices, table.points, atol=1e-6)


def test_written_laz_opens_in_laspy(table, tmp_path):
    path = written(table, ".laz", tmp_path)

    las = laspy.read(path)

    assert_allclose(las.xyz, table.points, atol=1e-6)
    assert_array_equal(las["label"], table.columns["label"])


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npz", ".txt", ".las"])
def test_awkward_columns_keep_numbers(suffix, tmp_path):
    unit = uniform_points(4, 0)
    points = unit + np.array([1e6, 0, 0])
    path = written(Table(points, AWKWARD), suffix, tmp_path)

    again = contents(path)

    assert_allclose(again.points, points, rtol=0, atol=1e-6)
    columns = [column for column in again.columns.values() if column.any()]
    for name, column in AWKWARD.items():
        is_equal = [np.array_equal(found, column) for found in columns]
        assert any(is_equal), name


FAR = uniform_points(20, 0) + np.array([1e9, 5.4e6, 100])


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz", ".xyz", ".las"])
def test_coordinates_far_from_origin_keep_digits(suffix, tmp_path):
    path = written(Table(FAR), suffix, tmp_path)

    again = read(path, 100, 0)

    assert_allclose(again.points, FAR, rtol=0, atol=1e-6)


def test_coordinates_far_from_origin_are_not_written_in_single_precision(tmp_path):
    with pytest.raises(UserError, match="holds float32"):
        written(Table(FAR), ".bin", tmp_path)


def test_strings_and_dates_of_a_structured_array_are_left_out(tmp_path):
    path = tmp_path / "a.npy"
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("n", "U3"), ("d", "M8[s]")]
    np.save(path, np.zeros(3, fields))

    assert not contents(path).columns


def test_strings_of_an_npz_file_are_left_out(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, points=np.ones((3, 3)), names=np.array(["a", "b", "c"]))

    assert not contents(path).columns


def test_first_of_two_columns_that_differ_in_capitals_alone_is_the_coordinate(tmp_path):
    source = tmp_path / "a.npy"
    out = tmp_path / "b.ply"
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("X", "f4")]
    np.save(source, np.array([(1, 2, 3, 9), (4, 5, 6, 8)], fields))

    table = contents(source)
    write_table(out, table)

    assert table.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert table.columns["X"].tolist() == [9, 8]
    again = contents(out)
    assert again.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert again.columns["X_"].tolist() == [9, 8]


WITH_LIST = """\
ply
format binary_little_endian 1.0
element vertex 2
property float x
property float y
property float z
property list uchar int l
end_header
"""


def test_lists_of_a_ply_file_are_left_out(tmp_path):
    path = tmp_path / "a.ply"
    row = struct.pack("<fffBi", 1, 2, 3, 1, 5)
    path.write_bytes(WITH_LIST.encode() + row + row)

    table = contents(path)

    assert table.points.tolist() == [[1, 2, 3], [1, 2, 3]]
    first = table.take(np.array([0]))
    assert first.points.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".bin", ".las", ".laz"])
def test_row_range_equals_slice_of_file(suffix, tmp_path):
    path = tmp_path / f"in{suffix}"
    points = normal_points(500, 1).astype(np.float32).astype(float)
    intensity = np.arange(500, dtype=np.uint16)
    write_cloud(path, points, {"intensity": intensity})

    cloud = open_cloud_file(path)
    whole = cloud.read(range(500)).points
    first = cloud.read(range(0, 3)).points
    middle = cloud.read(range(200, 400)).points
    last = cloud.read(range(499, 500)).points

    assert cloud.number == 500
    assert list(cloud.row_ranges(200)) == [range(200), range(200, 400), range(400, 500)]
    assert_allclose(whole, points, atol=1e-6)
    assert_array_equal(first, whole[:3])
    assert_array_equal(middle, whole[200:400])
    assert_array_equal(last, whole[499:])


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
            contents(tmp_path / name)


@pytest.mark.parametrize("suffix", WRITERS)
def test_full_disk_is_one_error(suffix, tmp_path):
    random = normal_points(3000, 0)
    with pytest.raises(UserError, match=rf"write .*a{suffix} \((?!.*None)"), full_disk():
        write(tmp_path / f"a{suffix}", Table(random))
    assert not list(tmp_path.iterdir())
