"""Laser scans without a header: .bin, .pcd.bin and .label."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.bin_columns import parse_columns
from mops_lightning.data.formats.registry import open_cloud_file, read, write
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents

NUSCENES = ("x", "y", "z", "intensity", "ring")


@pytest.fixture
def sweep():
    """400 points of five columns: 32 rings one after the other, as nuScenes has them."""
    random = np.random.default_rng(0)
    unit = random.normal(size=(400, 3))
    rows = np.empty((400, 5), np.float32)
    rows[:, :3] = unit * [20, 20, 1]
    rows[:, 3] = random.integers(0, 256, 400)
    rows[:, 4] = np.arange(400) % 32
    return rows


def test_read_pcd_bin_has_five_columns_in_parts_too(sweep, tmp_path):
    path = tmp_path / "n015__LIDAR_TOP__1.pcd.bin"
    sweep.tofile(path)

    whole = contents(path)
    part = open_cloud_file(path).read(range(100, 200))

    assert_array_equal(whole.points, sweep[:, :3])
    assert_array_equal(whole.columns["ring"], sweep[:, 4])
    assert_array_equal(part.columns["intensity"], sweep[100:200, 3])


def test_read_bin_with_other_columns_asks_for_their_names(sweep, tmp_path):
    path = tmp_path / "sweep.bin"
    sweep.tofile(path)  # 8,000 bytes would also be 500 rows of four columns

    with pytest.raises(UserError, match="Name its columns, such as --columns"):
        contents(path)
    with pytest.raises(UserError, match="does not look like"):
        open_cloud_file(path)
    table = read(path, 9, 0, columns=NUSCENES)

    assert_array_equal(table.points, sweep[:, :3])


def test_read_bin_of_room_with_colours_is_refused(tmp_path):
    path = tmp_path / "room.bin"
    random = np.random.default_rng(1)
    unit = random.random((400, 6), np.float32)
    rows = unit * np.array([4, 4, 2.5, 255, 255, 255], np.float32)
    rows.tofile(path)

    with pytest.raises(UserError, match="does not look like rows of x, y, z, intensity"):
        contents(path)


def test_read_bin_of_three_columns_is_refused_by_its_size(tmp_path):
    path = tmp_path / "a.bin"
    rows = np.ones((399, 3), np.float32)
    rows.tofile(path)

    with pytest.raises(UserError, match=r"4788 bytes are not rows of 4 float32 .*--columns"):
        contents(path)


@pytest.mark.parametrize(("least", "is_refused"), [(0.0, False), (-0.25, True)])
def test_read_bin_with_a_negative_intensity_asks_for_the_names(least, is_refused, tmp_path):
    path = tmp_path / "a.bin"
    rows = np.random.default_rng(0).random((20, 4), np.float32)
    rows[13, 3] = least
    rows.tofile(path)

    if is_refused:
        with pytest.raises(UserError, match=r"if these are right: --columns x,y,z,intensity"):
            contents(path)
    named = read(path, 9, 0, columns=("x", "y", "z", "intensity"))

    assert named.columns["intensity"][13] == least
    if not is_refused:
        assert_array_equal(contents(path).points, named.points)


@pytest.mark.parametrize(("number", "is_read"), [(31, True), (32, False)])
def test_read_bin_of_few_points_is_not_judged(number, is_read, tmp_path):
    """Five columns in a file of four: only with 32 points or more the numbers tell."""
    path = tmp_path / "a.bin"
    values = np.zeros(4 * number, np.float32)
    values[::5] = 100
    values.tofile(path)

    if is_read:
        assert len(contents(path).points) == number
    else:
        with pytest.raises(UserError, match="does not look like"):
            contents(path)


def test_label_file_beside_a_scan_comes_before_that_of_the_folder_of_labels(tmp_path):
    scan = tmp_path / "velodyne" / "0.bin"
    beside = tmp_path / "velodyne" / "0.label"
    in_labels = tmp_path / "labels" / "0.label"
    for path, label in ((beside, 5), (in_labels, 9)):
        path.parent.mkdir()
        np.full(40, label, "<u4").tofile(path)
    np.ones((40, 4), np.float32).tofile(scan)

    found = contents(scan).columns["label"]

    assert found.tolist() == [5] * 40


def rows_of_bin(path):
    return np.fromfile(path, "<f4").reshape(-1, 5)


def test_write_bin_keeps_the_columns_that_were_read(sweep, tmp_path):
    source = tmp_path / "a.bin"
    copy = tmp_path / "b.bin"
    coordinates = tmp_path / "b.pcd.bin"
    sweep.tofile(source)
    table = read(source, 9, 0, columns=NUSCENES)

    write(copy, table)
    write(coordinates, table.without_attributes())

    assert_array_equal(rows_of_bin(copy), sweep)
    without_attributes = sweep * [1, 1, 1, 0, 0]
    assert_array_equal(rows_of_bin(coordinates), without_attributes)


@pytest.mark.parametrize(
    ("scans", "labels"),
    [
        ("", ""),
        ("velodyne", "labels"),
    ],
)
def test_read_label_file_gives_class_and_instance(scans, labels, tmp_path):
    scan = tmp_path / scans / "000000.bin"
    label_file = tmp_path / labels / "000000.label"
    scan.parent.mkdir(exist_ok=True)
    label_file.parent.mkdir(exist_ok=True)
    rows = np.random.default_rng(0).random((40, 4), np.float32)
    rows.tofile(scan)
    classes = np.arange(40, dtype="<u4")
    instances = classes + 7
    packed = classes + (instances << 16)
    packed.tofile(label_file)

    whole = contents(scan).columns
    part = open_cloud_file(scan).read(range(10, 20)).columns

    assert whole["label"].tolist() == list(range(40))
    assert whole["instance"].tolist() == list(range(7, 47))
    assert part["label"].tolist() == list(range(10, 20))


def test_write_bin_keeps_the_columns_of_a_scan_with_labels(sweep, tmp_path):
    source = tmp_path / "a.bin"
    copy = tmp_path / "b.bin"
    sweep.tofile(source)
    np.ones(400, "<u4").tofile(tmp_path / "a.label")

    write(copy, read(source, 9, 0, columns=NUSCENES))

    assert_array_equal(rows_of_bin(copy), sweep)


def test_read_bin_of_nuscenes_is_known_by_its_name_in_capitals(sweep, tmp_path):
    path = tmp_path / "A.PCD.BIN"
    sweep.tofile(path)

    table = contents(path)

    assert_array_equal(table.columns["ring"], sweep[:, 4])


def test_write_bin_of_points_that_float32_moves_by_a_millionth_is_refused(tmp_path):
    """Float32 has steps of 1/128 m at 100 km, which is a millionth of 8 km."""
    near = np.array([[100_000.003, 0, 0], [109_000.0, 0, 0]])
    far = np.array([[100_000.003, 0, 0], [101_000.0, 0, 0]])

    write(tmp_path / "near.bin", Table(near))
    with pytest.raises(UserError, match=r"far from the origin, by up to 0\.003"):
        write(tmp_path / "far.bin", Table(far))


def test_read_label_file_of_another_scan_is_refused(tmp_path):
    scan = tmp_path / "a.bin"
    np.ones((40, 4), np.float32).tofile(scan)
    np.ones(39, "<u4").tofile(tmp_path / "a.label")

    with pytest.raises(UserError, match=r"a\.label has 156 bytes, not 4 for each of the 40 points"):
        contents(scan)


@pytest.mark.parametrize("text", ["x,y", "x,y,z,", "x,y,z,z", "a b c"])
def test_columns_without_axes_or_twice_are_refused(text):
    with pytest.raises(UserError, match="--columns must name all columns"):
        parse_columns(text)


def test_columns_are_split_at_commas():
    assert parse_columns("x, y,z,ring") == ("x", "y", "z", "ring")
