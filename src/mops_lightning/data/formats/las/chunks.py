"""Rows of LAZ files: chunks of any number of points, each compressed on its own.

lazrs's ``seek`` assumes that all chunks have the same number of points, which those of COPC files
do not have. Here a row is found by the file's table of chunks.
"""

import struct
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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


def read_rows(path: Path, first: int, record: bytes, item: int, total: int, rows: range) -> Bytes:
    """Return the bytes of a range of points, or of fewer where the file has no more.

    Args:
        path: the file.
        first: place of the points in the file.
        record: data of the record that describes the compression.
        item: bytes of a point.
        total: number of points.
        rows: of the points.
    """
    with path.open("rb") as file:
        chunks = _chunks(file, first, record, total)
        ends = list(accumulate(chunk.number for chunk in chunks))
        low, high = np.searchsorted(ends, [rows.start, rows.stop - 1], side="right")
        before = ends[low - 1] if low else 0
        wanted = range(rows.start - before, rows.stop - before)
        return decompress(file, chunks[low : high + 1], record, item, wanted)


def decompress(file: Any, chunks: list[Chunk], record: bytes, item: int, rows: range) -> Bytes:
    """Return the bytes of a range of the points of some chunks, or of fewer if they have fewer.

    Args:
        file: open for reading.
        chunks: in the order of their points.
        record: see ``read_rows``.
        item: see ``read_rows``.
        rows: counted from the first point of the first chunk.
    """
    parts = [np.empty(0, np.uint8)]
    first = 0
    for group in _groups(chunks):
        number = sum(chunk.number for chunk in group)
        low, high = max(rows.start - first, 0), min(rows.stop - first, number)
        if low < high:
            data = b"".join(_read(file, chunk) for chunk in group)
            parts.append(_decompress_group(data, group, record, item, range(low, high)))
        first += number
    return np.concatenate(parts)


def _groups(chunks: list[Chunk]) -> list[list[Chunk]]:
    """Group chunks that are decompressed together, by several threads."""
    groups: list[list[Chunk]] = []
    room = 0
    for chunk in chunks:
        if chunk.number > room:
            groups.append([])
            room = LARGEST
        groups[-1].append(chunk)
        room -= chunk.number
    return groups


def _decompress_group(
    data: bytes, chunks: list[Chunk], record: bytes, item: int, rows: range
) -> Bytes:
    import lazrs

    table = [(chunk.number, chunk.size) for chunk in chunks]
    number = sum(chunk.number for chunk in chunks)
    if number <= LARGEST:
        points = np.empty(number * item, np.uint8)
        lazrs.decompress_points_with_chunk_table(data, record, points, table)
        return points[rows.start * item : rows.stop * item]
    stream = BytesIO(struct.pack("<q", 8 + len(data)) + data)  # a LAZ file of one chunk
    stream.seek(0, 2)
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


def _chunks(file: Any, first: int, record: bytes, total: int) -> list[Chunk]:
    """Return the chunks of a file from its table, which does not know how full the last one is."""
    import lazrs

    file.seek(first)
    table = lazrs.read_chunk_table(file, lazrs.LazVlr(record))
    chunks = []
    start = first + 8  # after the place of the table
    for number, size in table:
        chunks.append(Chunk(start, size, min(number, total)))
        start += size
        total -= chunks[-1].number
    return chunks
