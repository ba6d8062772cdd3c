"""Rows of LAZ files: chunks of any number of points, each compressed on its own.

lazrs's ``seek`` assumes that all chunks have the same number of points, which those of COPC files
do not have. Here a row is found by the file's table of chunks.
"""

import struct
from collections.abc import Iterator
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.las.header import Header

Bytes = NDArray[np.uint8]

LARGEST = 1_000_000
"""Points of a chunk that is decompressed as a whole."""

STEP = 100_000
"""Points of a larger chunk that are decompressed at a time."""


class Chunk(NamedTuple):
    """Where a chunk is in a file: its first byte, number of bytes and number of points."""

    start: int
    size: int
    number: int


def read_rows(path: Path, header: Header, rows: range) -> Bytes:
    """Return the bytes of a range of points, or of fewer where the file has no more."""
    with path.open("rb") as file:
        chunks = _chunks(file, header)
        ends = list(accumulate(chunk.number for chunk in chunks))
        first_and_last = [rows.start, rows.stop - 1]
        low, high = np.searchsorted(ends, first_and_last, side="right")
        before = 0
        if low:
            before = ends[low - 1]
        wanted = range(rows.start - before, rows.stop - before)
        return decompress(file, header, chunks[low : high + 1], wanted)


def decompress(file: Any, header: Header, chunks: list[Chunk], rows: range) -> Bytes:
    """Return the bytes of a range of the points of some chunks, or of fewer if they have fewer.

    Args:
        file: open for reading.
        header: of the file.
        chunks: in the order of their points.
        rows: counted from the first point of the first chunk.
    """
    number = sum(chunk.number for chunk in chunks)
    stop = min(rows.stop, number)
    rows = range(rows.start, max(stop, rows.start))
    points = np.empty(len(rows) * header.item, np.uint8)
    done = 0
    first = 0
    for group in _groups(chunks):
        number = sum(chunk.number for chunk in group)
        low = max(rows.start - first, 0)
        high = min(rows.stop - first, number)
        if low < high:
            part = _decompress_group(file, header, group, range(low, high))
            points[done : done + len(part)] = part
            done += len(part)
        first += number
    return points


def _groups(chunks: list[Chunk]) -> Iterator[list[Chunk]]:
    """Group chunks that are decompressed together, by several threads."""
    group: list[Chunk] = []
    room = LARGEST
    for chunk in chunks:
        if group and chunk.number > room:
            yield group
            group = []
            room = LARGEST
        group.append(chunk)
        room -= chunk.number
    if group:
        yield group


def _decompress_group(file: Any, header: Header, chunks: list[Chunk], rows: range) -> Bytes:
    import lazrs

    item = header.item
    record = header.compression
    data = b"".join(_read(file, chunk) for chunk in chunks)
    table = [(chunk.number, chunk.size) for chunk in chunks]
    number = sum(chunk.number for chunk in chunks)
    if number <= LARGEST:
        points = np.empty(number * item, np.uint8)
        lazrs.decompress_points_with_chunk_table(data, record, points, table)
        return points[rows.start * item : rows.stop * item]
    stream = BytesIO()  # a LAZ file of one chunk
    place_of_table = struct.pack("<q", 8 + len(data))
    stream.write(place_of_table + data)
    lazrs.write_chunk_table(stream, table, lazrs.LazVlr(record))
    stream.seek(0)
    decompressor = lazrs.LasZipDecompressor(stream, record)
    for start in range(0, rows.start, STEP):
        skipped = min(STEP, rows.start - start)
        decompressor.decompress_many(np.empty(skipped * item, np.uint8))
    points = np.empty(len(rows) * item, np.uint8)
    decompressor.decompress_many(points)
    return points


def _read(file: Any, chunk: Chunk) -> bytes:
    file.seek(chunk.start)
    data: bytes = file.read(chunk.size)
    if len(data) < chunk.size:
        raise ValueError(f"it ends in the chunk at byte {chunk.start}")
    return data


def _chunks(file: Any, header: Header) -> list[Chunk]:
    """Return the chunks of a file from its table, which does not know how full the last one is."""
    import lazrs

    _check_table(file, header)
    file.seek(header.first)
    table = lazrs.read_chunk_table(file, lazrs.LazVlr(header.compression))
    left = header.number
    start = header.first + 8  # after the place of the table
    chunks = []
    for number, size in table:
        chunk = Chunk(start, size, min(number, left))
        chunks.append(chunk)
        start += size
        left -= chunk.number
    return chunks


def _check_table(file: Any, header: Header) -> None:
    """Reject many more chunks than points; lazrs may end the process for want of memory."""
    file.seek(header.first)
    (place,) = struct.unpack("<q", file.read(8))
    if place < 0:  # at the end of the file
        place = file.seek(-8, 2)
        (place,) = struct.unpack("<q", file.read(8))
    file.seek(max(place, 0))
    _, number = struct.unpack("<2I", file.read(8))
    if number > 2 * header.number + 1:
        raise ValueError(f"its table has {number:,} chunks of {header.number:,} points")
