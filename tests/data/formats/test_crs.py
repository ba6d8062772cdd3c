"""The records of the coordinate system of a COPC file, which must be in WKT."""

import struct
from types import SimpleNamespace

import pytest

from mops_lightning.data.formats.las import crs
from mops_lightning.data.formats.las.crs import PROJECTION, with_wkt
from mops_lightning.data.formats.las.header import Header, Record

OTHER = Record.new("me", 34736, b"mine", "of another user")
GEOTIFF = tuple(Record.new(PROJECTION, number, b"keys") for number in (34735, 34736, 34737))
WKT = Record.new(PROJECTION, 2112, b'PROJCS["a"]\0', "OGC WKT")


def header(records, extended=()):
    head = bytearray(375)
    struct.pack_into("<H", head, 6, 1)  # the GPS time is the standard one
    return Header(bytes(head), tuple(records), tuple(extended))


@pytest.fixture
def converted(monkeypatch):
    """Convert as pyproj does, which is no dependency; return what it was asked for."""
    asked = []

    def to_wkt(version, pretty):
        asked.append((version, pretty))
        return 'PROJCS["b"]'

    monkeypatch.setattr(crs, "_converted", lambda keys: SimpleNamespace(to_wkt=to_wkt))
    return asked


def test_geotiff_records_become_one_of_wkt_that_ends_in_a_zero_byte(converted):
    given = header([GEOTIFF[0], OTHER, *GEOTIFF[1:]])

    made = with_wkt(given)

    assert made.records == (OTHER, Record.new(PROJECTION, 2112, b'PROJCS["b"]\0', "OGC WKT"))
    assert made.encoding == 1 | 16
    assert converted == [("WKT1_GDAL", False)]


@pytest.mark.parametrize(
    ("records", "extended"),
    [
        ([], []),
        ([OTHER], []),
        ([WKT], []),
        ([*GEOTIFF, WKT], []),
        (GEOTIFF, [WKT]),
    ],
    ids=["none", "of another user", "wkt", "both", "wkt after the points"],
)
def test_records_with_wkt_or_without_keys_stay(records, extended, converted):
    made = with_wkt(header(records, extended))

    assert made.records == tuple(records)
    assert made.extended == tuple(extended)
    assert made.encoding == 1 | 16
    assert converted == []
