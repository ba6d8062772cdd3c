"""LAS and LAZ files, read and written by laspy, an extra.

laspy and lazrs trust the counts and offsets of a file: a wrong one makes them read for hours or ask
for more memory than the machine has. Both are therefore compared with the length of the file first.
"""

import struct
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import IO, Any

import numpy as np

from mops_lightning.data.formats.guard import BadCloudError, ends_early
from mops_lightning.data.formats.table import CloudFile, Column, Table, split_array, unique_names
from mops_lightning.errors import UserError

COPC = "copc"
"""The user of the records that index the points of a COPC file."""

SMALLEST = 227
"""Bytes of the shortest header (LAS 1.0 to 1.2)."""

VLR, EVLR = 54, 60
"""Bytes of the header of a variable length record, and of an extended one."""

POINTS_PER_BYTE = 1024
"""Largest number of points per byte of compressed data."""

LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Separately compressed parts of the items of point formats 6 to 10; extra bytes have one each."""

EXTRA_BYTES = 14


def read(path: Path) -> Table:
    """Read all points with all their dimensions; coordinates are scaled and shifted.

    Raises:
        UserError: laspy is not installed, or the file is broken.
    """
    with _open(path) as file:
        declared = file.header.point_count
        table = _table(file.read_points(declared), file.header)
    if len(table.points) < declared:
        raise ends_early(path, len(table.points))
    return table


def locate(path: Path) -> CloudFile:
    """Open a file to read ranges of its rows."""
    with _open(path) as file:
        return CloudFile(path, file.header.point_count, _parse_rows, file.header)


def _parse_rows(path: Path, rows: range) -> Table:
    """Read a range of rows.

    Raises:
        BadCloudError: points are far outside of the header's bounds: a damaged LAZ file may give
            any numbers.
    """
    with _laspy(path).open(path, read_evlrs=False) as file:
        file.seek(rows.start)
        table = _table(file.read_points(len(rows)), None)
        low, high = np.asarray(file.header.mins), np.asarray(file.header.maxs)
    far = (high - low).max()
    if far > 0 and ((table.points < low - far) | (table.points > high + far)).any():
        raise BadCloudError(f"{path} is broken: it has points far outside of its header's bounds.")
    return table


def _table(cloud: Any, header: Any) -> Table:
    """Make a table of laspy's points; an array of k numbers per point becomes k columns."""
    points = np.stack([np.asarray(getattr(cloud, axis), np.float64) for axis in "xyz"], 1)
    names = [name for name in cloud.point_format.dimension_names if name not in "XYZ"]
    columns: dict[str, Column] = {}
    for name in names:
        columns |= split_array(name, np.asarray(cloud[name]))
    return Table(points, columns, header)


def write(path: Path, table: Table) -> None:
    """Write a LAS or LAZ file like the one that was read, or one of plain coordinates."""
    laspy = _laspy(path)
    cloud = laspy.LasData(_header(laspy, table))
    cloud.x, cloud.y, cloud.z = table.points.T
    known = set(cloud.point_format.dimension_names)
    for name, column in unique_names(table).items():
        if name in known and _stored_exactly(cloud, name, column):
            continue
        kind = np.dtype("u1") if column.dtype.kind == "b" else column.dtype.newbyteorder("=")
        kind = np.dtype("f4") if kind == np.dtype("f2") else kind
        own = (f"{name}_" if name in known else name)[:32]
        cloud.add_extra_dim(laspy.ExtraBytesParams(name=own, type=kind))
        cloud[own] = column.astype(kind)
    cloud.write(path)


def _header(laspy: Any, table: Table) -> Any:
    """Return a header like the one of the file that was read.

    Without the index of COPC files, which does not fit other points, and without arrays of numbers,
    which the table has as columns.
    """
    if table.header is None:
        header = laspy.LasHeader(point_format=3, version="1.2")
        extent = float(np.ptp(table.points, axis=0).max())
        header.offsets = table.points.min(0)
        header.scales = np.full(3, max(extent, 1e-9) / 2**30)
        return header
    source = table.header
    form = deepcopy(source.point_format)
    header = laspy.LasHeader(point_format=form, version=str(source.version))
    header.offsets, header.scales = source.offsets, source.scales
    header.vlrs = [record for record in source.vlrs if record.user_id != COPC]
    extended = [record for record in source.evlrs or () if record.user_id != COPC]
    header.evlrs = laspy.vlrs.vlrlist.VLRList(extended)
    arrays = [d.name for d in source.point_format.extra_dimensions if d.num_elements > 1]
    header.remove_extra_dims(arrays)
    return header


def _stored_exactly(cloud: Any, name: str, column: Column) -> bool:
    """Store a column in a dimension of LAS, if the dimension's type holds its numbers."""
    with suppress(OverflowError, TypeError, ValueError), np.errstate(all="ignore"):
        cloud[name] = column
        if np.array_equal(np.asarray(cloud[name]), column):
            return True
    cloud[name] = np.zeros(len(column), np.uint8)
    return False


def _laspy(path: Path) -> Any:
    """Return laspy, or raise an error that says how to install it."""
    try:
        import laspy
    except ModuleNotFoundError:
        raise UserError(
            f"{path}: LAS and LAZ need laspy: pip install 'mops-lightning[las]'."
        ) from None
    return laspy


def _open(path: Path) -> Any:
    laspy = _laspy(path)
    _check_counts(path)
    return laspy.open(path)


def _check_counts(path: Path) -> None:
    """Reject a file that is not LAS, or whose counts and offsets do not fit its length."""
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
