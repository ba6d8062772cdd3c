"""Writing COPC files: an octree whose cells are chunks of LAZ (https://copc.io, version 1.0)."""

import struct
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.las.copc import ENTRY, HIERARCHY, INFO, Key
from mops_lightning.data.formats.las.header import COPC, EXTENDED_RECORD, Header, Record
from mops_lightning.data.formats.las.layout import Rows
from mops_lightning.data.formats.las.octree import GRID, Builder
from mops_lightning.data.formats.las.packing import plan
from mops_lightning.data.formats.las.writer import Summary, begin, compression, finish
from mops_lightning.data.formats.table import TableParts

TOGETHER = 250_000
"""Points that are compressed together, by several threads."""


class Cells:
    """Compresses cells into chunks, several at a time, and lists where they are."""

    def __init__(self, stream: BinaryIO, record: Record, summary: Summary) -> None:
        self.stream = stream
        self.record = record
        self.summary = summary
        self.first = stream.tell()
        stream.write(bytes(8))  # the place of the table of chunks
        self.waiting: list[tuple[Key, Rows]] = []
        self.chunks: list[tuple[int, int]] = []
        self.entries: list[bytes] = []

    def add(self, key: Key, rows: Rows) -> None:
        """Write a cell, or keep it to write it with others."""
        if not len(rows):
            entry = ENTRY.pack(*key, 0, 0, 0)
            self.entries.append(entry)
            return
        self.summary.add(rows)
        self.waiting.append((key, rows))
        number = sum(len(rows) for _, rows in self.waiting)
        if number >= TOGETHER:
            self._write_waiting()

    def _write_waiting(self) -> None:
        import lazrs

        buffer = BytesIO()
        layout = lazrs.LazVlr(self.record.data)
        compressor = lazrs.ParLasZipCompressor(buffer, layout)
        chunks = [rows.tobytes() for _, rows in self.waiting]
        compressor.compress_chunks(chunks)
        compressor.done()
        buffer.seek(0)
        table = lazrs.read_chunk_table(buffer, layout)
        start = self.stream.tell()
        for (key, _), (number, size) in zip(self.waiting, table, strict=True):
            entry = ENTRY.pack(*key, start, size, number)
            self.entries.append(entry)
            start += size
        total = sum(size for _, size in table)
        compressed = buffer.getbuffer()[8 : 8 + total]
        self.stream.write(compressed)
        self.chunks += table
        self.waiting.clear()

    def close(self) -> None:
        """Write what waits, and the table of chunks."""
        import lazrs

        if self.waiting:
            self._write_waiting()
        place = self.stream.tell()
        table = BytesIO()
        layout = lazrs.LazVlr(self.record.data)
        lazrs.write_chunk_table(table, self.chunks, layout)
        self.stream.write(table.getvalue())
        self.stream.seek(self.first)
        self.stream.write(struct.pack("<q", place))


def write_copc_parts(path: Path, table: TableParts) -> list[str]:
    """Write a COPC file, whose points need not fit in memory; return what it does not hold.

    Points of formats 0 to 3 become points of formats 6 and 7, which hold all of their dimensions.
    """
    form, parts = plan(path, table, copc=True)
    header = form.header
    record = compression(form.layout, variable=True)
    low, side = _cube(header, table)

    def with_info(place: int, size: int, times: tuple[float, float]) -> Header:
        half = side / 2
        info = INFO.pack(*low + half, half, side / GRID, place, size, *times)
        first = Record.new(COPC, 1, info, "COPC info VLR")
        records = (first, *header.records, record)
        return replace(header, records=records)

    with path.open("wb+") as stream:
        preliminary = with_info(0, 0, (0.0, 0.0))
        summary = Summary(preliminary, form.layout)
        begin(stream, preliminary, compressed=True)
        cells = Cells(stream, record, summary)
        builder = Builder(low, side, header.scales, header.offsets, cells.add, path.parent)
        packed = (form.pack(part) for part in parts)
        builder.build(packed, table.number)
        cells.close()
        page = b"".join(cells.entries)
        place = stream.seek(0, 2) + EXTENDED_RECORD.size
        hierarchy = Record.new(COPC, HIERARCHY, page, "EPT hierarchy")
        extended = [hierarchy, *header.extended]
        final = with_info(place, len(page), summary.times)
        finish(stream, final, True, summary, extended)
    return form.notes()


def _cube(header: Header, table: TableParts) -> tuple[NDArray[np.float64], float]:
    """Return the lowest corner and the side of the smallest cube around all points.

    Its lowest corner is that of the header's bounds: some readers, such as copclib 2.6, take that
    for the corner of the octree.
    """
    scales = np.array(header.scales)
    offsets = np.array(header.offsets)
    whole = np.rint((table.corners - offsets) / scales)
    low, high = whole * scales + offsets
    longest = float((high - low).max())
    return low, max(longest, float(scales.max()))
