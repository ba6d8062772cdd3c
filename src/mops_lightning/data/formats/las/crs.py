"""The coordinate system of a COPC file, which must be in WKT."""

import struct
from dataclasses import replace
from typing import Any

from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.las.header import Header, Record

PROJECTION = "LASF_Projection"
"""The user of the records of the coordinate system."""

WKT_RECORD = 2112
GEOTIFF_KEYS = 34735
GEOTIFF_RECORDS = (GEOTIFF_KEYS, 34736, 34737)
"""Numbers of these records."""

WKT = 1 << 4
"""Bit of the global encoding: the coordinate system is in WKT, as formats 6 to 10 require."""


def with_wkt(header: Header) -> Header:
    """Return a header whose coordinate system, if it has one, is in WKT.

    Raises:
        BadCloudError: it is in GeoTIFF keys that cannot be converted.
    """
    head = bytearray(header.head)
    struct.pack_into("<H", head, 6, header.encoding | WKT)
    records = (*header.records, *header.extended)
    projection = [record for record in records if record.user == PROJECTION]
    numbers = {record.number for record in projection}
    if WKT_RECORD in numbers or GEOTIFF_KEYS not in numbers:
        return replace(header, head=bytes(head))
    keys = next(record for record in projection if record.number == GEOTIFF_KEYS)
    system = _converted(keys)
    wkt = system.to_wkt("WKT1_GDAL", pretty=False).encode() + b"\0"
    others = [record for record in header.records if not _is_geotiff(record)]
    wkt_record = Record.new(PROJECTION, WKT_RECORD, wkt, "OGC WKT")
    return replace(header, head=bytes(head), records=(*others, wkt_record))


def _is_geotiff(record: Record) -> bool:
    return record.user == PROJECTION and record.number in GEOTIFF_RECORDS


def _converted(keys: Record) -> Any:
    """Return pyproj's coordinate system of GeoTIFF keys.

    Raises:
        BadCloudError: pyproj is not installed, or the keys name no registered system.
    """
    problem = "OUT: COPC needs the coordinate system in WKT, but IN has it in GeoTIFF keys. "
    try:
        import pyproj  # noqa: F401
    except ModuleNotFoundError:
        raise BadCloudError(f"{problem}Install pyproj to convert it, or write .laz.") from None
    from laspy.vlrs import VLR
    from laspy.vlrs.known import GeoKeyDirectoryVlr

    raw = VLR(PROJECTION, GEOTIFF_KEYS, "", keys.data)
    system = GeoKeyDirectoryVlr.from_raw(raw).parse_crs()
    if system is None:
        raise BadCloudError(f"{problem}They name no registered system: write .laz.")
    return system
