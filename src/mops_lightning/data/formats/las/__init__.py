"""LAS and LAZ files, read and written by laspy, an extra."""

from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from functools import partial
from math import ceil, log2
from pathlib import Path
from typing import Any

import numpy as np

from mops_lightning.data.formats import table as tables
from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.cloud_file import CloudFile
from mops_lightning.data.formats.columns import split_array, unique_names
from mops_lightning.data.formats.guard import BadCloudError, ends_early
from mops_lightning.data.formats.isolated import isolated
from mops_lightning.data.formats.las.chunks import read_rows
from mops_lightning.errors import UserError

COPC = "copc"
"""The user of the records that index the points of a COPC file."""

GAP = 2**16
"""Bytes that are read with their neighbours rather than left out."""

POINTS_PER_BYTE = 1024
"""Largest number of points per byte of a file, which may be compressed."""

RECORD, EXTENDED_RECORD = 54, 60
"""Least numbers of bytes of the records before and after the points."""


def read(path: Path) -> tables.Table:
    """Read all points with all their dimensions; coordinates are scaled and shifted.

    Raises:
        UserError: laspy is not installed, or the file is broken.
    """
    return isolated(_parse, path)


def locate(path: Path) -> CloudFile:
    """Open a file to read ranges of its rows.

    Raises:
        UserError: laspy is not installed, or the file is broken.
    """
    header = isolated(_parse_header, path)
    return CloudFile(path, header.point_count, partial(isolated, _parse_rows), header)


def locate_area(file: CloudFile, area: Area) -> CloudFile:
    """Return the part of a file in an area.

    The rows of a COPC file are then those of the cells of its octree that overlap the area.
    Nothing else is read.

    Raises:
        UserError: the file is broken, or lies outside of the box.
    """
    if file.header is None:
        return replace(file, area=area)
    low, high = np.asarray(file.header.mins), np.asarray(file.header.maxs)
    if (low > area.high).any() or (high < area.low).any():
        corners = ",".join(f"{number:.10g}" for number in (*low, *high))
        raise BadCloudError(f"--bounds: all points of {file.path} are in {corners}.")
    if not any(record.user_id == COPC for record in file.header.vlrs):
        return replace(file, area=area)
    number = isolated(_count_in_nodes, file.path, area)
    parse = partial(isolated, partial(_parse_nodes, area))
    return CloudFile(
        file.path, number, parse, file.header, replace(area, level=None, resolution=None)
    )


def _parse_header(path: Path) -> Any:
    _check_records(path)
    with _laspy(path).open(path) as file:
        header, size = file.header, path.stat().st_size
    if header.point_count > POINTS_PER_BYTE * size:
        raise BadCloudError(
            f"{path} is broken: {size:,} bytes cannot hold {header.point_count:,} points."
        )
    return header


def _check_records(path: Path) -> None:
    """Reject more records than the file can hold: laspy would read as many, for minutes."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(247)
    records = int.from_bytes(head[100:104], "little")
    extended = int.from_bytes(head[243:247], "little") if head[25:26] >= b"\x04" else 0
    if RECORD * records + EXTENDED_RECORD * extended > size:
        raise BadCloudError(
            f"{path} is broken: {size:,} bytes cannot hold {records + extended:,} records."
        )


def _parse(path: Path) -> tables.Table:
    declared = _parse_header(path).point_count
    with _laspy(path).open(path) as file:
        table = _table(file.read_points(declared), file.header)
    if len(table.points) < declared:
        raise ends_early(path, len(table.points))
    return table


def _parse_rows(path: Path, rows: range) -> tables.Table:
    """Read a range of rows.

    Raises:
        BadCloudError: points are far outside of the header's bounds: a damaged LAZ file may give
            any numbers.
    """
    laspy = _laspy(path)
    with laspy.open(path, read_evlrs=False) as file:
        header = file.header
        if not header.are_points_compressed:
            file.seek(rows.start)
            return _table_near(path, file.read_points(len(rows)), header)
        form, record = header.point_format, header.vlrs.get("LasZipVlr")[0].record_data
    first, total = header.offset_to_point_data, header.point_count
    points = read_rows(path, first, record, form.size, total, rows)
    packed = laspy.PackedPointRecord.from_buffer(points, form)
    cloud = laspy.ScaleAwarePointRecord(packed.array, form, header.scales, header.offsets)
    return _table_near(path, cloud, header)


def _count_in_nodes(path: Path, area: Area) -> int:
    with _laspy(path).CopcReader.open(path) as reader:
        return sum(node.point_count for node in _nodes(reader, area))


def ranges_of_bytes(path: Path, area: Area) -> list[tuple[int, int]]:
    """Return where the octree's cells that overlap an area are in a file: starts and ends.

    Cells with little between them are joined: an answer of a server takes as long as ``GAP`` bytes.
    """
    joined: list[tuple[int, int]] = []
    with _laspy(path).CopcReader.open(path) as reader:
        for node in _nodes(reader, area):
            start, stop = node.offset, node.offset + node.byte_size
            if joined and start - joined[-1][1] < GAP:
                start = joined.pop()[0]
            joined.append((start, stop))
    return joined


def _parse_nodes(area: Area, path: Path, rows: range) -> tables.Table:
    """Read a range of the rows of the octree's cells that overlap an area.

    Raises:
        BadCloudError: see ``_parse_rows``.
    """
    with _laspy(path).CopcReader.open(path) as reader:
        nodes, first = _nodes(reader, area), 0
        while nodes and first + nodes[0].point_count <= rows.start:
            first += nodes.pop(0).point_count
        ends = np.cumsum([node.point_count for node in nodes]) + first
        read = nodes[: 1 + np.searchsorted(ends, rows.stop)]
        # The public queries have no limit of memory.
        points = reader._fetch_and_decompress_points_of_nodes(read)
        table = _table_near(path, points, reader.header)
    return table.take(np.arange(len(table.points))[rows.start - first : rows.stop - first])


def _nodes(reader: Any, area: Area) -> list[Any]:
    """Return the cells of a COPC file's octree that overlap an area, in the order of the file."""
    from laspy.copc import Bounds, load_octree_for_query

    if not reader.root_page.entries:
        raise ValueError("it ends before its octree")
    levels, spacing = area.level, reader.copc_info.spacing
    if area.resolution is not None:  # the distance of points is halved at each level
        levels = max(0, ceil(log2(spacing) - log2(area.resolution)))
    box = Bounds(np.array(area.low), np.array(area.high))
    depth = None if levels is None else range(levels + 1)
    nodes = load_octree_for_query(reader.source, reader.copc_info, reader.root_page, box, depth)
    return sorted((n for n in nodes if n.point_count), key=lambda node: node.offset)


def _table_near(path: Path, cloud: Any, header: Any) -> tables.Table:
    """Make a table of points, none of which is far outside of the header's bounds."""
    table = _table(cloud, None)
    low, high = np.asarray(header.mins), np.asarray(header.maxs)
    far = (high - low).max()
    if far > 0 and ((table.points < low - far) | (table.points > high + far)).any():
        raise BadCloudError(f"{path} is broken: it has points far outside of its header's bounds.")
    return table


def _table(cloud: Any, header: Any) -> tables.Table:
    """Make a table of laspy's points; an array of k numbers per point becomes k columns."""
    points = np.stack([np.asarray(getattr(cloud, axis), np.float64) for axis in "xyz"], 1)
    names = [name for name in cloud.point_format.dimension_names if name not in "XYZ"]
    columns: dict[str, tables.Column] = {}
    for name in names:
        columns |= split_array(name, np.asarray(cloud[name]))
    return tables.Table(points, columns, header)


def write(path: Path, table: tables.Table) -> None:
    """Write a LAS or LAZ file like the one that was read, or one of plain coordinates."""
    write_parts(path, tables.TableParts.whole(table))


def write_parts(path: Path, table: tables.TableParts) -> None:
    """Write a LAS or LAZ file part by part."""
    laspy = _laspy(path)
    header = _header(laspy, table)
    dimensions = _add_dimensions(laspy, header, tables.Table(table.corners, table.columns))
    form = {"header": header, "do_compress": path.suffix.lower() == ".laz", "closefd": False}
    # Opened here, because laspy leaves its file open when the disk is full.
    with path.open("wb+") as stream, laspy.open(stream, mode="w", **form) as file:
        for part in table.parts:
            points = laspy.ScaleAwarePointRecord.zeros(len(part.points), header=header)
            points.x, points.y, points.z = part.points.T
            for name, column in unique_names(part).items():
                points[dimensions[name]] = column
            file.write_points(points)
        if header.evlrs:
            file.write_evlrs(header.evlrs)


def _add_dimensions(laspy: Any, header: Any, table: tables.Table) -> dict[str, str]:
    """Add what a header lacks for a table, and return the dimension of every column."""
    known = set(header.point_format.dimension_names)
    dimensions = {}
    for name, column in unique_names(table).items():
        if name in known and _holds(laspy, header, name, column):
            dimensions[name] = name
            continue
        kind = np.dtype("u1") if column.dtype.kind == "b" else column.dtype.newbyteorder("=")
        kind = np.dtype("f4") if kind == np.dtype("f2") else kind
        dimensions[name] = (f"{name}_" if name in known else name)[:32]
        header.add_extra_dim(laspy.ExtraBytesParams(name=dimensions[name], type=kind))
    return dimensions


def _header(laspy: Any, table: tables.TableParts) -> Any:
    """Return a header like the one of the file that was read.

    Without the index of COPC files, which does not fit other points, and without arrays of numbers,
    which the table has as columns.
    """
    if table.header is None:
        header = laspy.LasHeader(point_format=3, version="1.2")
        extent = float(np.ptp(table.corners, axis=0).max())
        header.offsets = table.corners[0]
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


def _holds(laspy: Any, header: Any, name: str, column: tables.Column) -> bool:
    """Return whether the type of a dimension of LAS holds the numbers of a column exactly."""
    points = laspy.ScaleAwarePointRecord.zeros(len(column), header=header)
    with suppress(OverflowError, TypeError, ValueError), np.errstate(all="ignore"):
        points[name] = column
        return np.array_equal(np.asarray(points[name]), column)
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
