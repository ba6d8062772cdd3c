"""Headers of LAS that are rare, wrong or new, and second readers of what is written."""

import struct
from dataclasses import replace

import copclib
import laspy
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.las.columns import LasColumns
from mops_lightning.data.formats.registry import open_cloud_file, read, write
from mops_lightning.data.formats.table import Table, TableParts
from mops_lightning.errors import UserError
from tests.support.clouds import uniform_points
from tests.support.las import full_cloud, header_fields

ENCODING, MINOR, BOUNDS, WAVEFORMS = 6, 25, 179, 227
"""Places in the header."""

WAVEFORMS_INSIDE = 2
"""Bit of the encoding."""


def patched(path, kind, place, *values):
    content = bytearray(path.read_bytes())
    struct.pack_into(kind, content, place, *values)
    path.write_bytes(content)


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_points_outside_of_the_headers_bounds_are_read_on_every_path(name, tmp_path):
    path = tmp_path / name
    cloud = full_cloud(6)
    cloud.write(path)
    patched(path, "<6d", BOUNDS, 1, 0, 1, 0, 1, 0)
    low = (5e5 - 100, 5.4e6 - 100, -9)
    high = (5e5 + 100, 5.4e6 + 100, 9)

    whole = read(path, 1, 0)
    file = open_cloud_file(path)
    parts = [file.read(rows).points for rows in file.row_ranges(70)]
    in_area = read(path, 1, 0, Area(low, high))

    joined = np.concatenate(parts)
    assert_array_equal(whole.points, cloud.xyz)
    assert_array_equal(joined, cloud.xyz)
    assert len(in_area.points) == 300


def as_version_15(path):
    """Make a file of LAS 1.4 one of 1.5: 18 more bytes of header, for times and their offset."""
    content = bytearray(path.read_bytes())
    content[MINOR] = 5
    (first,) = struct.unpack_from("<I", content, 96)
    (extended,) = struct.unpack_from("<Q", content, 235)
    struct.pack_into("<H", content, 94, 393)
    struct.pack_into("<I", content, 96, first + 18)
    struct.pack_into("<Q", content, 235, extended + 18)
    content[375:375] = struct.pack("<2dH", 9.0, 1.0, 1234)
    path.write_bytes(content)


def test_las_15_keeps_points_and_header_with_its_times(tmp_path):
    path = tmp_path / "a.las"
    out = tmp_path / "out.las"
    full_cloud(8).write(path)
    as_version_15(path)
    table = read(path, 1, 0)

    write(out, table.take(np.arange(7, 40)))

    cloud = laspy.read(path)
    again = laspy.read(out)
    assert_array_equal(again.points.array, cloud.points.array[7:40])
    assert header_fields(out) == header_fields(path)
    assert again.header.gps_time_offset == 1234
    assert again.header.min_gps_time == again.gps_time.min()
    assert again.header.max_gps_time == again.gps_time.max()


def test_las_15_does_not_become_copc(tmp_path):
    path = tmp_path / "a.las"
    full_cloud(8).write(path)
    as_version_15(path)
    table = read(path, 1, 0)

    with pytest.raises(UserError, match=r"COPC is LAS 1\.4, but IN is LAS 1\.5"):
        write(tmp_path / "out.copc.laz", table)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (MINOR, 6, r"is LAS 1\.6, but versions 1\.0 to 1\.5 are read"),
        (104, 11, "points of format 11, but formats 0 to 10 are read"),
    ],
)
def test_later_versions_are_refused_in_one_line(place, value, said, tmp_path):
    path = tmp_path / "a.las"
    full_cloud(6).write(path)
    patched(path, "<B", place, value)

    with pytest.raises(UserError, match=said):
        read(path, 1, 0)
    with pytest.raises(UserError, match=said):
        open_cloud_file(path)


def test_waveforms_inside_of_the_file_are_refused_unless_left_out(tmp_path):
    path = tmp_path / "a.las"
    out = tmp_path / "out.las"
    cloud = full_cloud(4)
    cloud.write(path)
    patched(path, "<Q", WAVEFORMS, path.stat().st_size)
    patched(path, "<H", ENCODING, WAVEFORMS_INSIDE)
    table = read(path, 1, 0)

    with pytest.raises(UserError, match="would lose the waveforms, which are inside of IN"):
        write(out, table)
    write(out, table.without_attributes())

    again = laspy.read(out)
    assert_array_equal(again.xyz, cloud.xyz)
    assert not again.header.start_of_waveform_data_packet_record
    assert not again.header.global_encoding.waveform_data_packets_internal


def bytes_by_point(cloud):
    number = len(cloud.points)
    flat = cloud.points.array.view(np.uint8)
    return flat.reshape(number, -1)


def test_undocumented_bytes_stay_and_are_documented_beside_a_new_dimension(tmp_path):
    path = tmp_path / "a.las"
    same = tmp_path / "b.las"
    longer = tmp_path / "c.las"
    label = np.arange(300)
    cloud = full_cloud(1)
    cloud.write(path)
    content = path.read_bytes()
    documentation = struct.pack("<16sH", b"LASF_Spec", 4)
    path.write_bytes(content.replace(documentation, bytes(18)))
    table = read(path, 1, 0)

    write(same, table)
    write(longer, table.with_columns({"label": label}))

    size = cloud.points.array.dtype.itemsize
    length = 300 * size
    assert same.read_bytes()[-length:] == path.read_bytes()[-length:]
    again = laspy.read(longer)
    documented = bytes_by_point(again)[:, :size]
    assert_array_equal(again["label"], label)
    assert_array_equal(documented, bytes_by_point(cloud))


@pytest.mark.parametrize("form", [0, 1, 2, 3, 6, 7, 8])
def test_written_laz_is_equal_in_both_of_laspys_backends(form, tmp_path):
    source = tmp_path / "a.las"
    out = tmp_path / "out.laz"
    cloud = full_cloud(form, 2000)
    cloud.write(source)

    write(out, read(source, 1, 0))

    for backend in (laspy.LazBackend.Lazrs, laspy.LazBackend.Laszip):
        again = laspy.read(out, laz_backend=backend)
        assert_array_equal(again.points.array, cloud.points.array)


@pytest.mark.parametrize("form", range(11))
def test_laz_of_laszip_is_read_exactly(form, tmp_path):
    path = tmp_path / "a.laz"
    cloud = full_cloud(form, 2000)
    cloud.write(path, laz_backend=laspy.LazBackend.Laszip)

    table = read(path, 1, 0)

    assert isinstance(table.columns, LasColumns)
    assert table.columns.rows.tobytes() == cloud.points.array.tobytes()


@pytest.mark.parametrize("form", [6, 7, 8])
def test_written_laz_is_read_by_copclib(form, tmp_path):
    source = tmp_path / "a.las"
    out = tmp_path / "out.laz"
    cloud = full_cloud(form)
    cloud.write(source)

    write(out, read(source, 1, 0))

    points = copclib.LazReader(str(out)).GetPoints()
    coordinates = np.array([(p.x, p.y, p.z) for p in points])
    assert_array_equal(coordinates, cloud.xyz)
    assert [p.gps_time for p in points] == list(cloud.gps_time)
    assert [p.classification for p in points] == list(cloud.classification)
    assert [p.return_number for p in points] == list(cloud.return_number)
    standard = laspy.PointFormat(form).size
    for point, expected in zip(points, bytes_by_point(cloud), strict=True):
        assert bytes(point.extra_bytes) == expected[standard:].tobytes()


def test_columns_of_other_formats_become_dimensions(tmp_path):
    points = uniform_points(20, 0)
    columns = {
        "classification": np.arange(20) + 250,  # too large for eight bits
        "a name of more than thirty-two bytes, cut": np.arange(20.0),
        "a name of more than thirty-two bytes, too": np.arange(20) - 5,
        "flag": np.arange(20) % 2 == 0,
        "half": np.arange(20).astype(np.float16),
    }

    path = tmp_path / "a.laz"

    write(path, Table(points, columns))

    again = laspy.read(path)
    names = list(again.point_format.extra_dimension_names)
    assert names == [
        "classification_",
        "a name of more than thirty-two b",
        "a name of more than thirty-two _",
        "flag",
        "half",
    ]
    for name, column in zip(names, columns.values(), strict=True):
        assert_array_equal(again[name], column)
    assert set(np.asarray(again.return_number)) == {1}
    assert str(again.header.version) == "1.2"


NO_DATA, SMALLEST, LARGEST = 1, 2, 4
EACH = NO_DATA | SMALLEST | LARGEST
"""Bits of an extra dimension's options."""


def entry_of(content, name):
    """Return where the description of an extra dimension begins."""
    name_of_32_bytes = name.encode().ljust(32, b"\0")
    return content.index(name_of_32_bytes) - 4


def with_range(path, name, kind, options, *numbers):
    """Document no_data, the smallest and the largest number of an extra dimension."""
    content = bytearray(path.read_bytes())
    entry = entry_of(content, name)
    other_options = content[entry + 3] & ~7
    content[entry + 3] = other_options | options
    for place, number in zip(RANGE_PLACES, numbers, strict=True):
        struct.pack_into(kind, content, entry + place, *number)
    path.write_bytes(content)


RANGE_PLACES = (40, 64, 88)
"""Of no_data, the smallest and the largest number, from the start of a description."""


def range_of(path, name, kind):
    content = path.read_bytes()
    entry = entry_of(content, name)
    return [struct.unpack_from(kind, content, entry + place) for place in RANGE_PLACES]


@pytest.mark.parametrize("name", ["out.las", "out.laz", "out.copc.laz"])
def test_ranges_of_extra_dimensions_are_those_of_the_points_that_are_kept(name, tmp_path):
    path = tmp_path / "a.las"
    out = tmp_path / name
    height = "height above ground"
    limits = SMALLEST | LARGEST
    row = np.arange(300)
    cloud = full_cloud(6)
    cloud["Amplitude"].array[:] = row
    cloud["Colors"][:] = np.arange(900).reshape(300, 3) % 256
    cloud[height][:] = row - 10
    cloud[height][50] = np.nan
    cloud.write(path)
    with_range(path, "Amplitude", "<Q", EACH, (50,), (0,), (299,))
    with_range(path, "Colors", "<3Q", EACH, (150, 178, 0), (0, 0, 0), (255, 255, 255))
    with_range(path, height, "<d", limits, (0,), (-10,), (289,))
    with_range(path, "long steps", "<q", 0, (0,), (7,), (8,))
    table = read(path, 1, 0)

    write(out, table.take(np.arange(50, 60)))

    no_data, smallest, largest = range_of(out, "Amplitude", "<Q")
    assert no_data == (50,)
    assert smallest == (51,)
    assert largest == (59,)
    no_data, smallest, largest = range_of(out, "Colors", "<3Q")
    assert no_data == (150, 178, 0)
    assert smallest == (153, 151, 152)
    assert largest == (177, 175, 179)
    no_data, smallest, largest = range_of(out, height, "<d")
    assert no_data == (0,)
    assert smallest == (41,)
    assert largest == (49,)
    not_documented = range_of(out, "long steps", "<q")
    assert not_documented == [(0,), (7,), (8,)]


@pytest.mark.parametrize("name", ["out.las", "out.laz", "out.copc.laz"])
def test_ranges_of_extra_dimensions_written_in_parts_are_those_of_all_parts(name, tmp_path):
    path = tmp_path / "a.las"
    out = tmp_path / name
    cloud = full_cloud(6)
    row = np.arange(300)
    cloud["Amplitude"].array[:] = np.roll(row, 150)
    cloud.write(path)
    with_range(path, "Amplitude", "<Q", SMALLEST | LARGEST, (0,), (7,), (8,))
    table = read(path, 1, 0)
    whole = TableParts.whole(table)
    parts = [table.take(rows) for rows in np.split(row, 3)]

    write(out, replace(whole, parts=parts))

    _, smallest, largest = range_of(out, "Amplitude", "<Q")
    assert smallest == (0,)
    assert largest == (299,)


@pytest.mark.parametrize("form", [4, 10])
def test_waveforms_that_stay_beside_the_input_are_said(form, tmp_path, capsys):
    source = tmp_path / "a.las"
    full_cloud(form).write(source)
    table = read(source, 1, 0)

    write(tmp_path / "out.las", table)

    said = capsys.readouterr().out
    assert said.endswith(
        "out.las: its waveforms are in the .wdp file beside the input: copy it, named like this "
        "file\n"
    )
    write(tmp_path / "plain.las", table.without_attributes())
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("name", ["out.las", "out.copc.laz"])
def test_another_grid_of_coordinates_is_said_with_the_largest_change(name, tmp_path, capsys):
    source = tmp_path / "a.npy"
    out = tmp_path / name
    points = np.array(
        [
            [0, 0, 0],
            [2**30, 0.25, 0.5],
            [7, 1, 0.75],
        ]
    )
    np.save(source, points)

    write(out, read(source, 1, 0))

    said = capsys.readouterr().out
    again = laspy.read(out)
    assert_array_equal(again.xyz, np.rint(points))
    assert said.endswith(
        f"{name}: coordinates are on a grid of 1, which changes them by up to 0.5\n"
    )


def test_coordinates_that_a_grid_holds_are_written_without_a_word(tmp_path, capsys):
    source = tmp_path / "a.npy"
    out = tmp_path / "out.las"
    points = np.array([[0, 0, 0], [1, 0.25, 0.5]], "f4")
    np.save(source, points)

    write(out, read(source, 1, 0))

    assert_array_equal(laspy.read(out).x, [0, 1])
    assert capsys.readouterr().out == ""
