"""Writing LAS and LAZ files."""

import struct
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np

from mops_lightning.data.formats.las.header import LASZIP, Header, Record
from mops_lightning.data.formats.las.layout import Layout, Rows
from mops_lightning.data.formats.las.packing import plan
from mops_lightning.data.formats.las.ranges import ExtraRanges
from mops_lightning.data.formats.table import TableParts

SOFTWARE = b"mops_lightning"

LEGACY_LIMIT = 2**32
"""Points that the counts of versions before 1.4 can hold."""


class Summary:
    """What the header says of all points: numbers, bounds, ranges of GPS times and extra bytes."""

    def __init__(self, header: Header, layout: Layout) -> None:
        self.layout = layout
        self.ranges = ExtraRanges(header, layout)
        self.number = 0
        self.returns = np.zeros(16, np.int64)
        self.low = np.full(3, np.iinfo(np.int64).max)
        self.high = np.full(3, np.iinfo(np.int64).min)
        self.times = (np.inf, -np.inf)

    def add(self, rows: Rows) -> None:
        """Count points."""
        self.number += len(rows)
        self.ranges.add(rows)
        returns = self.layout.dimensions["return_number"].get(rows)
        self.returns += np.bincount(returns, minlength=16)
        for axis, name in enumerate("XYZ"):
            self.low[axis] = min(self.low[axis], rows[name].min())
            self.high[axis] = max(self.high[axis], rows[name].max())
        if "gps_time" in self.layout.dimensions:
            times = rows["gps_time"]
            first, last = self.times
            self.times = (
                min(first, float(times.min())),
                max(last, float(times.max())),
            )

    def fill(self, head: bytearray) -> None:
        """Write the numbers, bounds and times into a header."""
        minor = head[25]
        struct.pack_into("<6I", head, 107, *self._legacy_counts(head))
        if minor >= 4:
            struct.pack_into("<16Q", head, 247, self.number, *self.returns[1:])
        for axis in range(3):
            (scale,) = struct.unpack_from("<d", head, 131 + 8 * axis)
            (offset,) = struct.unpack_from("<d", head, 155 + 8 * axis)
            high = self.high[axis] * scale + offset
            low = self.low[axis] * scale + offset
            struct.pack_into("<2d", head, 179 + 16 * axis, high, low)
        if minor >= 5:
            first, last = self.times
            struct.pack_into("<2d", head, 375, last, first)

    def _legacy_counts(self, head: bytearray) -> list[int]:
        """Return the number of points and of the returns 1 to 5; zeros where 1.4 forbids them."""
        minor = head[25]
        form = head[104] & 0x7F
        is_small = form < 6 and self.number < LEGACY_LIMIT
        if minor < 4 or (minor == 4 and is_small):
            return [self.number, *self.returns[1:6]]
        return [0, 0, 0, 0, 0, 0]


class Points(Protocol):
    """What takes packed points."""

    def write(self, rows: Rows) -> None:
        """Write points."""

    def close(self) -> None:
        """Write what follows the points."""


class PlainPoints:
    """Points of a LAS file."""

    def __init__(self, stream: BinaryIO) -> None:
        self.stream = stream

    def write(self, rows: Rows) -> None:
        """Write points."""
        self.stream.write(rows.tobytes())

    def close(self) -> None:
        """Nothing follows the points."""


class CompressedPoints:
    """Points of a LAZ file, compressed by several threads."""

    def __init__(self, stream: BinaryIO, record: Record) -> None:
        import lazrs

        self.compressor = lazrs.ParLasZipCompressor(stream, lazrs.LazVlr(record.data))

    def write(self, rows: Rows) -> None:
        """Write points."""
        self.compressor.compress_many(np.frombuffer(rows.tobytes(), np.uint8))

    def close(self) -> None:
        """Write the table of chunks."""
        self.compressor.done()


def compression(layout: Layout, variable: bool = False) -> Record:
    """Return the record that describes the compression of points.

    Args:
        layout: of the points.
        variable: chunks may have any numbers of points.
    """
    import lazrs

    extra = layout.dtype.itemsize - layout.standard.itemsize
    data = lazrs.LazVlr.new_for_compression(layout.format, extra, variable).record_data()
    return Record.new("laszip encoded", LASZIP, bytes(data), "http://laszip.org")


def write_parts(path: Path, table: TableParts) -> list[str]:
    """Write a LAS or LAZ file part by part; return what it does not hold."""
    form, parts = plan(path, table, copc=False)
    header = form.header
    summary = Summary(form.header, form.layout)
    is_compressed = path.suffix.lower() == ".laz"
    if is_compressed:
        record = compression(form.layout)
        header = replace(header, records=(*header.records, record))
    with path.open("wb+") as stream:
        begin(stream, header, is_compressed)
        points: Points = PlainPoints(stream)
        if is_compressed:
            points = CompressedPoints(stream, record)
        for part in parts:
            rows = form.pack(part)
            if len(rows):
                summary.add(rows)
                points.write(rows)
        points.close()
        finish(stream, header, is_compressed, summary, list(header.extended))
    return form.notes()


def begin(stream: BinaryIO, header: Header, compressed: bool) -> None:
    """Write the header and its records, as far as they are known before the points."""
    stream.write(_head(header, compressed))
    for record in header.records:
        stream.write(record.to_bytes())


def finish(
    stream: BinaryIO,
    header: Header,
    compressed: bool,
    summary: Summary,
    extended: list[Record],
) -> None:
    """Write the records after the points, and the final header and records before them."""
    end = stream.seek(0, 2)
    for record in extended:
        stream.write(record.to_bytes(extended=True))
    head = _head(header, compressed)
    summary.fill(head)
    if header.minor >= 4:
        first_extended = 0
        if extended:
            first_extended = end
        struct.pack_into("<QI", head, 235, first_extended, len(extended))
    stream.seek(0)
    stream.write(head)
    for record in summary.ranges.fill(header.records):
        stream.write(record.to_bytes())


def _head(header: Header, compressed: bool) -> bytearray:
    """Return the bytes of a header with the place of the points and the kind of file."""
    head = bytearray(header.head)
    head[58:90] = SOFTWARE.ljust(32, b"\0")
    size_of_records = sum(len(record.to_bytes()) for record in header.records)
    first = len(head) + size_of_records
    struct.pack_into("<2I", head, 96, first, len(header.records))
    head[104] &= 0x7F
    if compressed:
        head[104] |= 0x80
    return head
