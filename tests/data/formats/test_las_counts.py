"""What the header of a written file says of its points: counts by return, and the day."""

import struct
from datetime import date

import laspy
import numpy as np
import pytest

from mops_lightning.data.formats.las import packing
from mops_lightning.data.formats.registry import read, write
from mops_lightning.data.formats.table import Table
from tests.support.las import full_cloud

OLD_COUNTS, LONG_COUNTS = 107, 247
"""Places of the number of points, which those of each return follow."""

RETURNS = np.array([1] * 9 + [2] * 6 + [3] * 4 + [5] * 2 + [7])
"""Of 22 points; the last two kinds are lost in the counts of old headers or in part of them."""


def write_returns(path, form, version):
    cloud = laspy.LasData(laspy.LasHeader(point_format=form, version=version))
    cloud.x = np.arange(len(RETURNS))
    cloud.return_number = RETURNS
    cloud.number_of_returns = np.full(len(RETURNS), 7)
    cloud.write(path)


@pytest.mark.parametrize(
    ("form", "version", "old", "long"),
    [
        (1, "1.2", [20, 8, 6, 4, 0, 2], None),
        (1, "1.4", [20, 8, 6, 4, 0, 2], [20, 8, 6, 4, 0, 2, 0, 0]),
        (6, "1.4", [0, 0, 0, 0, 0, 0], [20, 8, 6, 4, 0, 2, 0, 0]),
    ],
)
def test_written_header_counts_points_by_return(form, version, old, long, tmp_path):
    source = tmp_path / "a.las"
    out = tmp_path / "b.laz"
    write_returns(source, form, version)

    write(out, read(source, 1, 0).take(np.arange(1, 21)))

    content = out.read_bytes()
    assert list(struct.unpack_from("<6I", content, OLD_COUNTS)) == old
    if long is not None:
        assert list(struct.unpack_from("<8Q", content, LONG_COUNTS)) == long


def test_written_header_counts_the_seventh_return(tmp_path):
    source = tmp_path / "a.las"
    out = tmp_path / "b.copc.laz"
    write_returns(source, 6, "1.4")

    write(out, read(source, 1, 0))

    counts = struct.unpack_from("<16Q", out.read_bytes(), LONG_COUNTS)
    assert list(counts) == [22, 9, 6, 4, 0, 2, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0]


def test_old_count_of_points_holds_where_the_long_one_is_zero(tmp_path):
    path = tmp_path / "a.las"
    write_returns(path, 1, "1.4")
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, OLD_COUNTS, 22)
    struct.pack_into("<Q", content, LONG_COUNTS, 0)
    path.write_bytes(content)

    table = read(path, 1, 0)

    assert table.points[:, 0].tolist() == list(range(22))


class LastDayOfLeapYear(date):
    """A calendar on which today is the 366th day of 2028."""

    @classmethod
    def today(cls):
        return cls(2028, 12, 31)


def test_new_file_has_the_day_on_which_it_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(packing, "date", LastDayOfLeapYear)
    out = tmp_path / "a.las"

    write(out, Table(np.eye(3)))

    assert laspy.read(out).header.creation_date == date(2028, 12, 31)


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_new_file_says_what_wrote_it_and_how_its_numbers_are_stored(name, tmp_path):
    path = tmp_path / name
    points = np.array([[5.0, -2.0, 1.0], [13.0, 0.0, 1.5]])

    write(path, Table(points))

    head = path.read_bytes()
    header = laspy.read(path).header
    assert head[26:58] == b"OTHER".ljust(32, b"\0")
    assert head[58:90] == b"mops_lightning".ljust(32, b"\0")
    assert header.scales.tolist() == [8 / 2**30] * 3
    assert header.offsets.tolist() == [5.0, -2.0, 1.0]
    assert header.mins.tolist() == [5.0, -2.0, 1.0]
    assert header.maxs.tolist() == [13.0, 0.0, 1.5]
    assert header.are_points_compressed == (name == "a.laz")
    assert (str(header.version), header.point_format.id) == ("1.2", 3)


@pytest.mark.parametrize("target", ["b.las", "b.laz"])
def test_copy_without_records_after_its_points_says_of_no_place_for_them(target, tmp_path):
    source = tmp_path / "a.laz"
    cloud = full_cloud(6)
    cloud.evlrs = None
    cloud.write(source)

    write(tmp_path / target, read(source, 1, 0))

    head = (tmp_path / target).read_bytes()
    place, number = struct.unpack_from("<QI", head, 235)
    assert (place, number) == (0, 0)
    assert bool(head[104] & 0x80) == (target == "b.laz")
