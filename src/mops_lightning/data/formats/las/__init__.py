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
    return CloudFile(path, header.number, partial(_parse_rows, _small(header)), header)


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
        corners = ",".join(f"{number:.10g}" for corner in header.bounds for number in corner)
        raise BadCloudError(f"--bounds: all points of {file.path} are in {corners}.")
    number = sum(cell.number for cell in cells)
    parse = partial(_parse_cells, _small(header), area)
    return CloudFile(file.path, number, parse, header, replace(area, level=None, resolution=None))


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
    start = header.first + rows.start * header.item
    packed = np.fromfile(path, np.uint8, len(rows) * header.item, offset=start)
    return _table(path, header, packed[: len(packed) // header.item * header.item])


def _parse_cells(header: Header, area: Area, path: Path, rows: range) -> tables.Table:
    """Read a range of the rows of the cells that overlap an area."""
    return _table(path, header, isolated(partial(copc.read_cells, area), path, header, rows))


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
    for place, axis in enumerate("XYZ"):
        least, most = int(rows[axis].min()), int(rows[axis].max())
        ends = np.array([least, most]) * header.scales[place] + header.offsets[place]
        room = (high - low).max()
        outside = ends[0] < low[place] - room or ends[1] > high[place] + room
        if outside and most - least > DAMAGED:
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
