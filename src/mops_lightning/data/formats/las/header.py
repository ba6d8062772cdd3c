"""The header of LAS files as bytes, so that what is not changed is written as it was read.

Layout: ASPRS, "LAS Specification 1.4 - R16" and "LAS 1.5", 2025.
"""

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mops_lightning.data.formats.guard import BadCloudError

COPC = "copc"
"""The user of the records that index the points of a COPC file."""

SPEC = "LASF_Spec"
"""The user of the records that the specification defines."""

EXTRA_BYTES, WAVEFORMS = 4, 65535
"""Numbers of records of the specification: extra dimensions; waveforms inside of the file."""

LASZIP = 22204
"""Number of the record that describes the compression."""

ITEMS_PLACE = 32
"""Byte of this record at which the number of items begins; the items of a point follow it."""

ITEMS_NUMBER = struct.Struct("<H")

ITEM = struct.Struct("<3H")
"""An item: its type, its length in bytes and its version."""

HEADER_BYTES = (227, 227, 227, 235, 375, 393)
"""Least bytes of the header of versions 1.0 to 1.5."""

FORMATS = range(11)
"""Known formats of points."""

POINTS_PER_BYTE = 1024
"""Largest number of points per byte of a file, which may be compressed."""

RECORD = struct.Struct("<2s16sHH32s")
EXTENDED_RECORD = struct.Struct("<2s16sHQ32s")
"""Heads of the records before and after the points."""


@dataclass(frozen=True)
class Record:
    """A record before or after the points."""

    reserved: bytes
    user_bytes: bytes
    number: int
    description: bytes
    data: bytes

    @property
    def user(self) -> str:
        """Who defines the record."""
        return self.user_bytes.split(b"\0")[0].decode("latin-1")

    @classmethod
    def new(cls, user: str, number: int, data: bytes, description: str = "") -> "Record":
        """Make a record of text and data."""
        return cls(b"\0\0", user.encode(), number, description.encode(), data)

    def to_bytes(self, extended: bool = False) -> bytes:
        """Return the record as it is written before the points, or after them."""
        head = EXTENDED_RECORD if extended else RECORD
        size = len(self.data)
        return head.pack(self.reserved, self.user_bytes, self.number, size, self.description) + (
            self.data
        )


@dataclass(frozen=True)
class Header:
    """The header of a file and its records.

    Attributes:
        head: the bytes of the header itself.
        records: before the points.
        extended: after the points, without waveforms and the octree of a COPC file.
        waveforms_inside: whether the waveforms are in the file.
    """

    head: bytes
    records: tuple[Record, ...] = ()
    extended: tuple[Record, ...] = field(default=(), repr=False)
    waveforms_inside: bool = False

    def _number(self, kind: str, place: int) -> int:
        number: int = struct.unpack_from(kind, self.head, place)[0]
        return number

    def _vector(self, place: int) -> tuple[float, ...]:
        return struct.unpack_from("<3d", self.head, place)

    @property
    def minor(self) -> int:
        """Version 1.minor."""
        return self.head[25]

    @property
    def encoding(self) -> int:
        """Bits: type of the GPS time, waveforms, synthetic returns, WKT."""
        return self._number("<H", 6)

    @property
    def format(self) -> int:
        """Format of the points, 0 to 10."""
        return self.head[104] & 0x7F

    @property
    def compressed(self) -> bool:
        """Whether this is a LAZ file."""
        return bool(self.head[104] & 0x80)

    @property
    def item(self) -> int:
        """Bytes of a point."""
        return self._number("<H", 105)

    @property
    def first(self) -> int:
        """Place of the points in the file."""
        return self._number("<I", 96)

    @property
    def number(self) -> int:
        """Number of points."""
        old = self._number("<I", 107)
        if self.minor < 4:
            return old
        return self._number("<Q", 247) or old

    @property
    def scales(self) -> tuple[float, ...]:
        """Steps of x, y and z."""
        return self._vector(131)

    @property
    def offsets(self) -> tuple[float, ...]:
        """Coordinates of the whole numbers 0, 0, 0."""
        return self._vector(155)

    @property
    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lowest and highest coordinates as the header says; points may be outside of them."""
        high_low = struct.unpack_from("<6d", self.head, 179)
        return high_low[1::2], high_low[::2]

    def record(self, user: str, number: int) -> Record | None:
        """Return the first record before the points of this user and number."""
        same = (r for r in self.records if (r.user, r.number) == (user, number))
        return next(same, None)

    @property
    def copc(self) -> Record | None:
        """The record with the octree's cube and place; None: this is no COPC file."""
        return self.record(COPC, 1)

    @property
    def compression(self) -> bytes:
        """The data of the record that describes the compression.

        Raises:
            ValueError: there is none, or its points have another length than the header's: lazrs
                would decompress for minutes.
        """
        record = self.record("laszip encoded", LASZIP)
        if record is None:
            raise ValueError("no record describes its compression")
        length = _length_of_compressed_point(record.data)
        if length != self.item:
            raise ValueError(
                f"the record of its compression has points of {length} bytes, its header of "
                f"{self.item}"
            )
        return record.data


def _length_of_compressed_point(data: bytes) -> int:
    """Return the length of a point in bytes: the sum over its items.

    Args:
        data: of the record that describes the compression.

    Raises:
        ValueError: it ends before its last item.
    """
    start = ITEMS_PLACE + ITEMS_NUMBER.size
    if len(data) < start:
        raise ValueError("the record of its compression is too short")
    (number,) = ITEMS_NUMBER.unpack_from(data, ITEMS_PLACE)
    items = data[start : start + number * ITEM.size]
    if len(items) < number * ITEM.size:
        raise ValueError(f"the record of its compression is too short for {number} items")
    return sum(length for _, length, _ in ITEM.iter_unpack(items))


def read_header(path: Path) -> Header:
    """Read and check a header.

    Raises:
        BadCloudError: the file is broken, or of a later version.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES[0])
        if len(head) < HEADER_BYTES[0] or head[:4] != b"LASF":
            raise BadCloudError(f"{path} is broken: it does not begin with a header of LAS.")
        major, minor = head[24], head[25]
        if major != 1 or minor >= len(HEADER_BYTES):
            raise BadCloudError(
                f"{path} is LAS {major}.{minor}, but versions 1.0 to 1.5 are read. Convert it."
            )
        (announced,) = struct.unpack_from("<H", head, 94)
        head += file.read(max(announced - len(head), 0))
        if len(head) < HEADER_BYTES[minor]:
            raise BadCloudError(f"{path} is broken: its header has {len(head)} bytes.")
        header = Header(head)
        if header.format not in FORMATS:
            raise BadCloudError(
                f"{path} has points of format {header.format}, but formats 0 to 10 are read."
            )
        _check_counts(path, header, size)
        records = _read_records(file, header, size)
        extended, inside = _read_extended(file, header, size)
    return Header(head, records, extended, inside)


def _extended_place(header: Header) -> tuple[int, int]:
    """Return the place and the number of the records after the points."""
    if header.minor < 4:
        return 0, 0
    return struct.unpack_from("<QI", header.head, 235)


def _check_counts(path: Path, header: Header, size: int) -> None:
    """Reject more records or points than the file can hold."""
    records = struct.unpack_from("<I", header.head, 100)[0]
    extended = _extended_place(header)[1]
    if RECORD.size * records + EXTENDED_RECORD.size * extended > size:
        raise BadCloudError(
            f"{path} is broken: {size:,} bytes cannot hold {records + extended:,} records."
        )
    if header.number > POINTS_PER_BYTE * size:
        raise BadCloudError(
            f"{path} is broken: {size:,} bytes cannot hold {header.number:,} points."
        )


def _read_records(file: BinaryIO, header: Header, size: int) -> tuple[Record, ...]:
    number = struct.unpack_from("<I", header.head, 100)[0]
    file.seek(len(header.head))
    records = []
    for _ in range(number):
        reserved, user, identifier, length, description = RECORD.unpack(file.read(RECORD.size))
        data = file.read(length)
        records.append(Record(reserved, user, identifier, description, data))
    reach_into_points = file.tell() > min(header.first, size)
    is_cut = bool(records) and len(records[-1].data) < length
    if reach_into_points or is_cut:
        raise ValueError("its records reach into its points")
    return tuple(records)


def _read_extended(file: BinaryIO, header: Header, size: int) -> tuple[tuple[Record, ...], bool]:
    """Return the records after the points, and whether waveforms are among them."""
    place, number = _extended_place(header)
    # In version 1.3 the waveforms are the only such record.
    inside = False
    if header.minor == 3:
        (place_of_waveforms,) = struct.unpack_from("<Q", header.head, 227)
        inside = place_of_waveforms > 0
    records = []
    for _ in range(number):
        file.seek(place)
        head = file.read(EXTENDED_RECORD.size)
        reserved, user, identifier, length, description = EXTENDED_RECORD.unpack(head)
        place += EXTENDED_RECORD.size + length
        if place > size:
            raise ValueError("its last records reach behind its end")
        record = Record(reserved, user, identifier, description, b"")
        if (record.user, identifier) == (SPEC, WAVEFORMS):
            inside = True
        elif record.user != COPC:
            records.append(Record(reserved, user, identifier, description, file.read(length)))
    return tuple(records), inside
