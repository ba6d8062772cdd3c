"""E57 files, written by pye57."""

import sys
from typing import Any

import numpy as np
import pye57
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pye57 import libe57

from mops_lightning.data.formats import e57, splats
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents
from tests.support.downsample import done, refused

QUARTER_TURN = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
"""Quaternion of a quarter turn about z."""


def scan(number, **more):
    random = np.random.default_rng(number)
    columns: dict[str, Any] = {}
    for axis in AXES:
        columns[axis] = random.random(30)
    columns["intensity"] = random.random(30, np.float32)
    for colour in COLOURS:
        columns[colour] = random.integers(0, 256, 30, np.uint8)
    return columns | more


AXES = ("cartesianX", "cartesianY", "cartesianZ")
COLOURS = ("colorRed", "colorGreen", "colorBlue")


def points_of(data):
    points = np.column_stack([data[axis] for axis in AXES])
    return points.astype(np.float32)


def test_read_e57_joins_scans_at_their_poses(tmp_path):
    path = tmp_path / "a.e57"
    first = scan(1)
    second = scan(2)
    first_shift = np.array([1000.5, 2000.0, 0.0])
    second_shift = np.array([0.0, 0.0, 5.0])
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(first, translation=first_shift)
        file.write_scan_raw(second, rotation=QUARTER_TURN, translation=second_shift)

    table = contents(path)

    x, y, z = points_of(second).T
    turned = np.column_stack([-y, x, z])
    of_first = points_of(first) + first_shift
    of_second = turned + second_shift
    expected = np.concatenate([of_first, of_second])
    columns = table.columns
    assert_allclose(table.points, expected, atol=1e-12)
    assert columns["scan"].tolist() == [0] * 30 + [1] * 30
    assert columns["red"].dtype == np.uint8
    assert_array_equal(columns["red"][:30], first["colorRed"])
    assert_array_equal(columns["intensity"][30:], second["intensity"])


def test_cartesian_of_ranges_azimuths_and_elevations():
    eighth = np.pi / 4
    seen = np.array(
        [
            [2, 0, 0],
            [2, 2 * eighth, 0],
            [2, eighth, eighth],
            [2, 0, -2 * eighth],
        ]
    )

    points = e57._cartesian(seen)

    expected = [[2, 0, 0], [0, 2, 0], [1, 1, np.sqrt(2)], [0, 0, -2]]
    assert_allclose(points, expected, atol=1e-12)


def write_fields(path, fields, **extensions):
    """Write one scan with any fields, each as float64, which pye57 itself does not write."""
    with pye57.E57(str(path), mode="w") as file:
        image = file.image_file
        for prefix, address in extensions.items():
            image.extensionsAdd(prefix, address)
        prototype = libe57.StructureNode(image)
        buffers = libe57.VectorSourceDestBuffer()
        number = len(next(iter(fields.values())))
        for name, values in fields.items():
            prototype.set(name, libe57.FloatNode(image, 0.0))
            buffers.append(libe57.SourceDestBuffer(image, name, values, number, True, True))
        codecs = libe57.VectorNode(image, True)
        points = libe57.CompressedVectorNode(image, prototype, codecs)
        scan_node = libe57.StructureNode(image)
        scan_node.set("guid", libe57.StringNode(image, "{1}"))
        scan_node.set("points", points)
        file.data3d.append(scan_node)
        points.writer(buffers).write(number)


FIELDS = {
    "intensity": ("intensity", np.float32, 0.5),
    "colorRed": ("red", np.uint8, 1),
    "colorGreen": ("green", np.uint8, 2),
    "colorBlue": ("blue", np.uint8, 3),
    "rowIndex": ("row", np.uint16, 1004),
    "columnIndex": ("column", np.int32, 100_005),
    "returnIndex": ("return_index", np.uint8, 6),
    "returnCount": ("return_count", np.uint8, 7),
    "timeStamp": ("time", np.float64, 3e8 + 0.1),
    "nor:normalX": ("nx", np.float32, 0.0),
    "nor:normalY": ("ny", np.float32, 0.625),
    "nor:normalZ": ("nz", np.float32, -1.0),
}
"""Every field that is read, with its column, the type of this and a number."""


def test_every_field_of_a_scan_has_its_column(tmp_path):
    path = tmp_path / "a.e57"
    fields = {}
    for place, axis in enumerate(AXES):
        fields[axis] = np.array([1.5, -2.5]) + 10 * place
    for field, (_, _, number) in FIELDS.items():
        fields[field] = np.full(2, float(number))
    fields["cartesianInvalidState"] = np.array([0.0, 0.0])
    fields["isColorInvalid"] = np.array([0.0, 0.0])
    write_fields(path, fields, nor="http://www.libe57.org/E57_NOR_surface_normals.txt")

    table = contents(path)

    assert table.points.tolist() == [[1.5, 11.5, 21.5], [-2.5, 7.5, 17.5]]
    found = {name: (column.dtype, column.tolist()) for name, column in table.columns.items()}
    assert found == {name: (np.dtype(kind), [value] * 2) for name, kind, value in FIELDS.values()}
    assert table.form.left_out == ("isColorInvalid",)


def test_spherical_scan_is_read_without_its_invalid_points(tmp_path):
    path = tmp_path / "a.e57"
    quarter = np.pi / 2
    fields = {
        "sphericalRange": np.array([2.0, 2.0, 2.0, 2.0]),
        "sphericalAzimuth": np.array([0.0, quarter, 0.0, 0.0]),
        "sphericalElevation": np.array([0.0, 0.0, quarter, 0.0]),
        "sphericalInvalidState": np.array([0.0, 0.0, 0.0, 1.0]),
    }
    write_fields(path, fields)

    points = contents(path).points

    assert_allclose(points[:3], [[2, 0, 0], [0, 2, 0], [0, 0, 2]], atol=1e-12)
    assert np.isnan(points[3]).all()


@pytest.mark.parametrize(
    ("name", "numbers", "kind"),
    [
        ("red", [0, 255], np.uint8),
        ("row", [0, 256], np.uint16),
        ("row", [-1, 70_000], np.int32),
        ("row", [0, 2**40], np.float64),
        ("intensity", [0.5, np.nan], np.float32),
        ("time", [0.5, 0.1], np.float64),
    ],
)
def test_numbers_of_scans_get_the_smallest_type_that_holds_them(name, numbers, kind):
    values = np.array(numbers, np.float64)

    column = e57._narrow(name, values)

    assert column.dtype == kind
    assert_array_equal(column, values)


def test_read_e57_names_what_one_of_its_scans_lacks(tmp_path):
    path = tmp_path / "a.e57"
    without_intensity = scan(2)
    del without_intensity["intensity"]
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(scan(1))
        file.write_scan_raw(without_intensity)

    table = contents(path)

    assert sorted(table.columns) == ["blue", "green", "red", "scan"]
    assert table.form.left_out == ("intensity",)


def test_downsample_e57_leaves_invalid_points_out(tmp_path):
    path = tmp_path / "a.e57"
    invalid = np.zeros(30, np.int8)
    invalid[:3] = 1
    invalid[3] = 2  # only its direction is valid
    data = scan(1, cartesianInvalidState=invalid)
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(data)

    said = done(path, tmp_path / "b.ply", "--method", "fps", "--m", 10)

    assert "10 of 26 points (4 more without finite coordinates left out)" in said


def test_e57_as_output_is_refused_with_the_reason(tmp_path):
    source = tmp_path / "a.npy"
    np.save(source, np.ones((9, 3)))

    said = refused(source, tmp_path / "b.e57", "--method", "fps", "--m", 3)

    assert "pye57 stores coordinates in single precision" in said


def test_broken_e57_is_named(tmp_path):
    path = tmp_path / "a.e57"
    path.write_bytes(b"ASTM-E57" + bytes(90))

    with pytest.raises(UserError, match=r"a\.e57 is broken"):
        contents(path)


PARSERS = {
    "a.e57": e57._parse,
    "a.spz": splats._parse_spz,
}


@pytest.mark.parametrize(
    ("name", "module", "extra"),
    [
        ("a.e57", "pye57", "e57"),
        ("a.spz", "gsply", "splats"),
    ],
)
def test_missing_library_gets_one_line(name, module, extra, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    parse = PARSERS[name]

    with pytest.raises(UserError, match=rf"{module}: pip install 'mops-lightning\[{extra}\]'"):
        parse(tmp_path / name)
