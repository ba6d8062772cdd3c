"""Counts and offsets of LAS and LAZ files, compared with the length of the file.

laspy and lazrs trust them: a wrong count makes them read for hours or ask for more memory than the
machine has.
"""

import struct
from pathlib import Path
from typing import IO, Any

from mops_lightning.data.formats.errors import BadCloudError, ends_early

SMALLEST = 227
"""Bytes of the shortest header, that of LAS 1.0 to 1.2."""

VLR, EVLR = 54, 60
"""Bytes of the header of a variable length record, and of an extended one."""

POINTS_PER_BYTE = 1024
"""Most points that a byte of compressed data stands for."""

LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Separately compressed parts of the items of point formats 6 to 10; extra bytes have one each."""

EXTRA_BYTES = 14


def check(path: Path) -> None:
    """Reject a file whose counts and offsets do not fit its length.

    Raises:
        BadCloudError: one does not, or the file is not LAS.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
        if len(head) < SMALLEST or head[:4] != b"LASF":
            raise BadCloudError(f"{path} is broken: it has no LAS header.")
        header_size, start, vlrs, form, length, number = struct.unpack_from("<HIIBHI", head, 94)
        _within(path, "the point data", start, size)
        _within(path, f"{vlrs} variable length records", header_size + vlrs * VLR, start)
        if head[25] >= 4 and len(head) == 375:
            first, evlrs, number = struct.unpack_from("<QIQ", head, 235)
            end = first + evlrs * EVLR if evlrs else 0
            _within(path, f"{evlrs} extended variable length records", end, size)
            for _ in range(evlrs):
                file.seek(first)
                (record_length,) = struct.unpack_from("<Q", file.read(EVLR).ljust(EVLR, b"\0"), 20)
                first += EVLR + record_length
                _within(path, "an extended variable length record", first, size)
        if not length:
            raise BadCloudError(f"{path} is broken: its points have no bytes.")
        if not form & 0xC0:
            if number * length > size - start:
                raise ends_early(path, (size - start) // length)
        elif number:
            _check_compressed(path, file, start, size, number, length)


def _check_compressed(
    path: Path, file: IO[bytes], start: int, size: int, number: int, length: int
) -> None:
    """Compare the chunks of a LAZ file with its length and its number of points."""
    import laspy
    import lazrs

    file.seek(0)
    vlrs = laspy.LasHeader.read_from(file, read_evlrs=False).vlrs
    record = vlrs[vlrs.index("LasZipVlr")].record_data
    vlr = lazrs.LazVlr(record)
    if vlr.item_size() != length:
        raise BadCloudError(
            f"{path} is broken: points of {length} bytes, items of {vlr.item_size()} bytes."
        )
    file.seek(start)
    (table,) = struct.unpack("<q", file.read(8))
    if table == -1:  # written by a program that could not go back; the offset is at the end
        file.seek(-8, 2)
        (table,) = struct.unpack("<q", file.read(8))
    _within(path, "the chunk table", table + 8 if table >= start else size + 1, size)
    file.seek(table + 4)
    (chunks,) = struct.unpack("<I", file.read(4))
    _within(path, f"{chunks} chunks", start + 8 + chunks * vlr.item_size(), size)
    file.seek(start)
    found = lazrs.read_chunk_table(file, vlr)
    if sum(points for points, _ in found) < number or number > POINTS_PER_BYTE * size:
        raise BadCloudError(f"{path} is broken: {chunks} chunks cannot hold {number} points.")
    layers = _layers(record)
    place = start + 8
    for _, used in found:
        _within(path, "a chunk", place + used, table)
        if layers:
            file.seek(place + vlr.item_size() + 4)
            sizes = struct.unpack(f"<{layers}I", file.read(4 * layers))
            needed = vlr.item_size() + 4 + 4 * layers + sum(sizes)
            _within(path, "a chunk's layers", place + needed, place + used)
        place += used


def _layers(record: Any) -> int:
    """Return the number of layers of a chunk, 0 for the formats that have none."""
    (items,) = struct.unpack_from("<H", record, 32)
    kinds = [struct.unpack_from("<HH", record, 34 + 6 * place) for place in range(items)]
    return sum(size if kind == EXTRA_BYTES else LAYERS.get(kind, 0) for kind, size in kinds)


def _within(path: Path, part: str, end: int, limit: int) -> None:
    if end > limit:
        raise BadCloudError(
            f"{path} is broken: {part} ends at byte {end}, but must end at byte {limit} at most."
        )
