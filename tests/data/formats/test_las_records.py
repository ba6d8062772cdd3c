"""Records of extra dimensions that are rare or wrong, as other programs write them."""

import struct

import laspy
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.registry import read, write
from tests.support.cloud_files import contents

ENTRY = 192
"""Bytes of the description of an extra dimension."""

NAME, TYPE, OPTIONS, SMALLEST, LARGEST = 4, 2, 3, 64, 88
"""Places in a description."""

RANGE = 2 | 4
"""Options of a dimension whose smallest and largest numbers are documented."""

ROW = np.arange(20)


def write_with_extra(path, *kinds):
    """Write 20 points with extra dimensions of the row, and arrays of the row plus 100."""
    header = laspy.LasHeader(point_format=1, version="1.2")
    for name, kind in kinds:
        header.add_extra_dim(laspy.ExtraBytesParams(name, kind))
    cloud = laspy.LasData(header)
    cloud.x = ROW
    cloud.y = ROW
    cloud.z = ROW
    for name, kind in kinds:
        values = ROW
        if kind[0].isdigit():
            values = np.repeat(ROW[:, None] + 100, int(kind[0]), axis=1)
        cloud[name] = values
    cloud.write(path)


def change_record(path, change):
    """Replace the descriptions of extra dimensions in a file."""
    content = bytearray(path.read_bytes())
    head = content.index(struct.pack("<2x16sH", b"LASF_Spec", 4))
    (length,) = struct.unpack_from("<H", content, head + 20)
    start = head + 54
    changed = change(bytes(content[start : start + length]))
    content[start : start + length] = changed
    struct.pack_into("<H", content, head + 20, len(changed))
    (first,) = struct.unpack_from("<I", content, 96)
    struct.pack_into("<I", content, 96, first + len(changed) - length)
    path.write_bytes(content)


def with_bytes(description, *places_and_values):
    """Return a description with other bytes at some places."""
    changed = bytearray(description)
    for place, value in places_and_values:
        changed[place] = value
    return bytes(changed)


def entry_named(path, name):
    """Return the description of an extra dimension in a file."""
    content = path.read_bytes()
    start = content.index(name.encode().ljust(32, b"\0")) - NAME
    return content[start : start + ENTRY]


def test_names_of_extra_dimensions_are_in_utf8(tmp_path):
    source = tmp_path / "a.las"
    out = tmp_path / "b.las"
    write_with_extra(source, ("Höhe", "u2"))

    write(out, contents(source))

    assert contents(source).columns["Höhe"].tolist() == ROW.tolist()
    assert contents(out).columns["Höhe"].tolist() == ROW.tolist()


def test_name_of_a_records_user_ends_at_its_first_zero_byte(tmp_path):
    path = tmp_path / "a.las"
    write_with_extra(path, ("label", "u2"))
    content = path.read_bytes()
    user = b"LASF_Spec".ljust(16, b"\0")
    assert content.count(user) == 1
    path.write_bytes(content.replace(user, b"LASF_Spec\0junk\0\0"))

    columns = contents(path).columns

    assert columns["label"].tolist() == ROW.tolist()


def with_two_undocumented_entries(record):
    """Put an entry of no bytes first, and leave the first dimension undocumented."""
    no_bytes = bytes(ENTRY)
    three_bytes = with_bytes(record[:ENTRY], (TYPE, 0), (OPTIONS, 3))
    with_range = with_bytes(record[ENTRY:], (OPTIONS, RANGE))
    return no_bytes + three_bytes + with_range


@pytest.mark.parametrize("name", ["out.las", "out.laz"])
def test_entries_of_undocumented_bytes_stand_before_others(name, tmp_path):
    source = tmp_path / "a.las"
    out = tmp_path / name
    write_with_extra(source, ("padding", "3u1"), ("label", "u2"))
    change_record(source, with_two_undocumented_entries)
    table = read(source, 1, 0)

    write(out, table.take(ROW[5:9]))

    assert table.columns["label"].tolist() == ROW.tolist()
    assert table.columns["padding_2"].tolist() == [row + 100 for row in range(20)]
    again = read(out, 1, 0).columns
    assert again["label"].tolist() == [5, 6, 7, 8]
    assert again["padding_0"].tolist() == [105, 106, 107, 108]
    label = entry_named(out, "label")
    assert struct.unpack_from("<Q", label, SMALLEST) == (5,)
    assert struct.unpack_from("<Q", label, LARGEST) == (8,)


def with_surplus_bytes(record):
    return record + b"surplus"


def with_a_type_that_is_too_long(record):
    """Document eight bytes where a point has two: the record is invalid."""
    float64 = 10
    return with_bytes(record, (TYPE, float64))


@pytest.mark.parametrize(
    ("change", "name_of_old"),
    [
        (with_surplus_bytes, "old"),
        (with_a_type_that_is_too_long, "ExtraBytes"),
    ],
)
def test_dimension_added_to_an_odd_record_is_read_by_laspy(change, name_of_old, tmp_path):
    source = tmp_path / "a.las"
    out = tmp_path / "b.las"
    write_with_extra(source, ("old", "u2"))
    change_record(source, change)
    table = read(source, 1, 0)

    write(out, table.with_columns({"new": ROW * 3}))

    again = laspy.read(out)
    assert list(again.point_format.extra_dimension_names) == [name_of_old, "new"]
    assert_array_equal(again["new"], ROW * 3)
    old_bytes = np.ascontiguousarray(again[name_of_old]).view(np.uint8).reshape(20, 2)
    assert_array_equal(old_bytes[:, 0], ROW)
