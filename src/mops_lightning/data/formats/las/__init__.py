"""LAS, LAZ and COPC files. laspy describes the points, lazrs compresses them; both are an extra."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from mops_lightning.data.formats import table as tables
from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.cloud_file import CloudFile
from mops_lightning.data.formats.guard import BadCloudError, ends_early
from mops_lightning.data.formats.isolated import isolated
from mops_lightning.data.formats.las import chunks, copc, copc_writer, writer
from mops_lightning.data.formats.las.columns import table_of
from mops_lightning.data.formats.las.header import Header, read_header
from mops_lightning.data.formats.las.layout import Rows, layout_of
from mops_lightning.errors import UserError

DAMAGED = 2**30
"""Steps between coordinates of neighbours in a file that only damage explains."""


def read(path: Path) -> tables.Table:
    """Read all points with all their dimensions; coordinates are scaled and shifted.

    Raises:
        UserError: laspy is not installed, or the file is broken.
    """
    file = locate(path)
    table = file.parse(path, range(file.number))
    if len(table.points) < file.number:
        raise ends_early(path, len(table.points))
    return replace(table, header=file.header)


def locate(path: Path) -> CloudFile:
    """Open a file to read ranges of its rows.

    Raises:
        UserError: laspy is not installed, or the file is broken.
    """
    _check_installed(path)
    header = read_header(path)
    layout_of(header)  # reports its mistakes now
    parse = partial(_parse_rows, _small(header))
    return CloudFile(path, header.number, parse, header)


def locate_area(file: CloudFile, area: Area) -> CloudFile:
    """Return the part of a file in an area.

    The rows of a COPC file are then those of the cells of its octree that overlap the area.
    Nothing else is read.

    Raises:
        UserError: the file is broken, or no cell overlaps the area.
    """
    header = file.header
    if header is None or header.copc is None:
        return replace(file, area=area)
    cells = isolated(copc.cells, file.path, header, area)
    if not cells:
        numbers = [f"{number:.10g}" for corner in header.bounds for number in corner]
        corners = ",".join(numbers)
        raise BadCloudError(f"--bounds: all points of {file.path} are in {corners}.")
    number = sum(cell.number for cell in cells)
    parse = partial(_parse_cells, _small(header), area)
    bounds = replace(area, level=None, resolution=None)
    return CloudFile(file.path, number, parse, header, bounds)


def ranges_of_bytes(path: Path, area: Area) -> list[tuple[int, int]]:
    """Return where the cells that overlap an area are in a COPC file: starts and ends."""
    return copc.ranges_of_bytes(path, read_header(path), area)


def write(path: Path, table: tables.Table) -> list[str]:
    """Write a LAS or LAZ file like the one that was read, or one of plain coordinates.

    Returns:
        What the file does not hold, in words; so do the other writers.
    """
    return write_parts(path, tables.TableParts.whole(table))


def write_parts(path: Path, table: tables.TableParts) -> list[str]:
    """Write a LAS or LAZ file part by part."""
    _check_installed(path)
    return writer.write_parts(path, table)


def write_copc(path: Path, table: tables.Table) -> list[str]:
    """Write a COPC file."""
    return write_copc_parts(path, tables.TableParts.whole(table))


def write_copc_parts(path: Path, table: tables.TableParts) -> list[str]:
    """Write a COPC file part by part."""
    _check_installed(path)
    return copc_writer.write_copc_parts(path, table)


def _small(header: Header) -> Header:
    """Return a header without the records after the points, which no point needs."""
    return replace(header, extended=())


def _parse_rows(header: Header, path: Path, rows: range) -> tables.Table:
    """Read a range of rows, or fewer where the file ends."""
    if header.compressed:
        packed = isolated(chunks.read_rows, path, header, rows)
        return _table(path, header, packed)
    size = header.item
    start = header.first + rows.start * size
    packed = np.fromfile(path, np.uint8, len(rows) * size, offset=start)
    whole_rows = len(packed) // size
    return _table(path, header, packed[: whole_rows * size])


def _parse_cells(header: Header, area: Area, path: Path, rows: range) -> tables.Table:
    """Read a range of the rows of the cells that overlap an area."""
    read_cells = partial(copc.read_cells, area)
    packed = isolated(read_cells, path, header, rows)
    return _table(path, header, packed)


def _table(path: Path, header: Header, packed: chunks.Bytes) -> tables.Table:
    layout = layout_of(header)
    rows = packed.view(layout.dtype)
    if header.compressed:
        _check_plausible(path, header, rows)
    return table_of(header, layout, rows)


def _check_plausible(path: Path, header: Header, rows: Rows) -> None:
    """Reject coordinates as damage to compressed points gives them.

    The header's bounds may be wrong, so points outside of them are no damage by themselves.
    """
    if not len(rows):
        return
    low, high = (np.array(bound) for bound in header.bounds)
    room = (high - low).max()
    for place, axis in enumerate("XYZ"):
        least = int(rows[axis].min())
        most = int(rows[axis].max())
        ends = np.array([least, most]) * header.scales[place] + header.offsets[place]
        is_below = ends[0] < low[place] - room
        is_above = ends[1] > high[place] + room
        if (is_below or is_above) and most - least > DAMAGED:
            raise BadCloudError(
                f"{path} is broken: it has points far outside of its header's bounds."
            )


def _check_installed(path: Path) -> None:
    """Raise an error that says how to install laspy where it is missing."""
    try:
        import laspy
        import lazrs  # noqa: F401
    except ModuleNotFoundError:
        raise UserError(
            f"{path}: LAS and LAZ need laspy: pip install 'mops-lightning[las]'."
        ) from None
    assert laspy.point.dims
