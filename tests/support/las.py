"""LAS files with a value in every place of the header and every dimension of a point."""

import struct
from datetime import date
from pathlib import Path
from typing import Any
from uuid import UUID

import laspy
import numpy as np
from numpy.typing import NDArray

WAVEFORM_FORMATS = (4, 5, 9, 10)
VERSIONS = dict.fromkeys(range(4), "1.2") | dict.fromkeys((4, 5), "1.3")
EXTRA = [
    laspy.ExtraBytesParams("height above ground", "f4"),
    laspy.ExtraBytesParams("points", "u1", "a reserved word elsewhere"),
    laspy.ExtraBytesParams("intensity_", "u2"),
    laspy.ExtraBytesParams("Amplitude", "u2", scales=[0.01], offsets=[5.0], no_data=[0]),
    laspy.ExtraBytesParams("long steps", "i8", scales=[0.001], offsets=[0.0]),
    laspy.ExtraBytesParams("Colors", "3u1"),
    laspy.ExtraBytesParams("a name of exactly thirty-two b.s", "i8"),
]
"""Extra dimensions with awkward names, scales and arrays."""


def full_cloud(form: int, number: int = 300) -> laspy.LasData:
    """Make a cloud with random numbers in all dimensions and rows as ``point_source_id``."""
    header = laspy.LasHeader(point_format=form, version=VERSIONS.get(form, "1.4"))
    header.scales = np.array([0.01, 0.01, 0.001])
    header.offsets = np.array([5e5, 5.4e6, 0])
    header.file_source_id = 77
    header.uuid = UUID(int=2**100 + 3)
    header.system_identifier = "MERGE"
    header.creation_date = date(2019, 5, 4)
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.global_encoding.synthetic_return_numbers = True
    header.global_encoding.wkt = form >= 6
    header.global_encoding.waveform_data_packets_external = form in WAVEFORM_FORMATS
    vegetation = struct.pack("<B15s", 5, b"veg. > 2 m (?)")
    header.vlrs += [
        laspy.VLR("LASF_Projection", 2112, "WKT", b'LOCAL_CS["somewhere"]\0'),
        laspy.VLR("LASF_Spec", 0, "classes", vegetation),
        laspy.VLR("somebody", 9, "notes", bytes(range(256))),
    ]
    header.add_extra_dims(EXTRA)
    cloud = laspy.LasData(header)
    random = np.random.default_rng(form)
    cloud.points.array = np.zeros(number, cloud.point_format.dtype())
    for dimension in cloud.point_format.dimensions:
        fill(cloud, dimension, random)
    cloud["X"], cloud["Y"], cloud["Z"] = random.integers(-5000, 5000, (3, number))
    cloud.point_source_id = np.arange(number)
    cloud["long steps"].array[:] += 2**60
    if header.version.minor >= 4:
        note = laspy.VLR("somebody", 10, "long note", bytes(70_000))
        cloud.evlrs = laspy.vlrs.vlrlist.VLRList([note])
    return cloud


def fill(cloud: laspy.LasData, dimension: Any, random: np.random.Generator) -> None:
    """Write random numbers into a dimension."""
    kinds = laspy.DimensionKind
    columns = cloud.points.array
    shape = (len(columns), dimension.num_elements)
    if dimension.kind == kinds.BitField:
        end = 2**dimension.num_bits
        cloud[dimension.name] = random.integers(0, end, len(columns))
        return
    values: NDArray[Any]
    if dimension.kind == kinds.FloatingPoint:
        values = random.normal(size=shape) * 1000
    elif dimension.kind == kinds.UnsignedInteger:
        values = random.integers(1, 100, shape)
    else:
        values = random.integers(-100, 100, shape)
    columns[dimension.name] = values.squeeze()


def header_fields(path: Path) -> dict[str, Any]:
    """Return what a copy of a file must have in common with it, from the bytes of its header."""
    content = path.read_bytes()
    fields: dict[str, Any] = {
        "source id and encoding": content[4:8],
        "identifier": content[8:24],
        "version": content[24:26],
        "system": content[26:58],
        "date": content[90:94],
        "scales and offsets": content[131:179],
        "records": [],
    }
    for record in records(content):
        user = record[0].rstrip(b"\0")
        if user != b"laszip encoded":
            fields["records"].append(record)
    minor_version = content[25]
    if minor_version >= 4:
        fields["extended"] = extended_records(content)
    return fields


def records(content: bytes) -> list[tuple]:
    """Return user, number, description and data of the records before the points.

    The smallest and largest numbers of extra dimensions are left out: they are those of the points.
    """
    (start,) = struct.unpack_from("<H", content, 94)
    (number,) = struct.unpack_from("<I", content, 100)
    written = []
    for _ in range(number):
        user, identifier, length, text = struct.unpack_from("<2x16sHH32s", content, start)
        end = start + 54 + length
        data = bytearray(content[start + 54 : end])
        describes_dimensions = user.rstrip(b"\0") == b"LASF_Spec" and identifier == 4
        if describes_dimensions:
            for description in range(0, length, 192):
                data[description + 64 : description + 112] = bytes(48)
        written.append((user, identifier, text, bytes(data)))
        start = end
    return written


def extended_records(content: bytes) -> list[tuple]:
    """Return user, number, description and data of the records after the points."""
    start, number = struct.unpack_from("<QI", content, 235)
    written = []
    for _ in range(number):
        user, identifier, length, text = struct.unpack_from("<2x16sHQ32s", content, start)
        end = start + 60 + length
        data = content[start + 60 : end]
        written.append((user, identifier, text, data))
        start = end
    return written
