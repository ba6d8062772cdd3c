"""Tables as the packed points of a file to write, and the header of that file."""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import date
from itertools import chain
from pathlib import Path

import numpy as np

from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.las.columns import LasColumns
from mops_lightning.data.formats.las.crs import WKT, with_wkt
from mops_lightning.data.formats.las.header import (
    COPC,
    EXTRA_BYTES,
    HEADER_BYTES,
    LASZIP,
    SPEC,
    Header,
    Record,
)
from mops_lightning.data.formats.las.layout import (
    EXTRA,
    Extra,
    Layout,
    Rows,
    documented_extra,
    is_extra,
    layout_of,
)
from mops_lightning.data.formats.table import Column, Table, TableParts

INSIDE = 1 << 1
"""Bit of the global encoding: the waveforms are inside of the file."""

WAVEFORM_FORMATS = (4, 5, 9, 10)
"""Formats whose points refer to waveforms."""

MODERN = {0: 6, 1: 6, 2: 7, 3: 7}
"""The formats of LAS 1.4 that hold all dimensions of older ones."""

OLD_FORMAT = 3
"""The format of LAS 1.2 with times and colours."""

DEGREES = 0.006
"""Step of the angle in formats 6 to 10; older ones have whole degrees."""


@dataclass
class Plan:
    """What a file will be like.

    Attributes:
        header: with the final records, but without counts, bounds and places.
        layout: of its points.
        names: the dimension of every column that is not packed.
        has_waveforms: whether its points refer to waveforms in a file beside the input.
        on_new_grid: whether its coordinates are those of a file, on another grid.
        moved: largest change of a coordinate so far.
    """

    header: Header
    layout: Layout
    names: dict[str, str]
    has_waveforms: bool = False
    on_new_grid: bool = False
    moved: float = 0.0

    def notes(self) -> list[str]:
        """Return what the file does not hold, when all points are packed."""
        notes = []
        if self.has_waveforms:
            notes.append(
                "its waveforms are in the .wdp file beside the input: copy it, named like this file"
            )
        if self.on_new_grid and self.moved:
            notes.append(
                f"coordinates are on a grid of {self.header.scales[0]:.2g}, which changes them by "
                f"up to {self.moved:.2g}"
            )
        return notes

    def pack(self, table: Table) -> Rows:
        """Return the packed points ``(n,)`` of a part of the table."""
        rows = np.zeros(len(table.points), self.layout.dtype)
        columns = table.columns
        if isinstance(columns, LasColumns):
            _copy_packed(columns, rows, self.layout)
            columns = columns.changes
        else:
            self._set_coordinates(rows, table)
        for name, column in columns.items():
            dimension = self.layout.dimensions[self.names[name]]
            dimension.set(rows, column)
        return rows

    def _set_coordinates(self, rows: Rows, table: Table) -> None:
        """Set the coordinates, and the number of returns, of which a point has one at least."""
        axes = zip("XYZ", self.header.scales, self.header.offsets, table.points.T, strict=True)
        for axis, scale, offset, values in axes:
            rows[axis] = np.rint((values - offset) / scale)
            changes = np.abs(rows[axis] * scale + offset - values)
            self.moved = max(self.moved, float(changes.max(initial=0.0)))
        ones = np.ones(len(rows), np.uint8)
        self.layout.dimensions["return_number"].set(rows, ones)
        self.layout.dimensions["number_of_returns"].set(rows, ones)


def _copy_packed(packed: LasColumns, rows: Rows, layout: Layout) -> None:
    """Copy all dimensions of packed points to points of a layout."""
    if packed.layout.format != layout.format:
        _modernise(packed, rows, layout)
        return
    # Added dimensions come last, so that the old bytes of a point are the first ones of the new.
    size = packed.layout.dtype.itemsize
    old = np.ascontiguousarray(packed.rows).view(np.uint8)
    old_bytes = old.reshape(len(rows), -1)
    new_bytes = rows.view(np.uint8).reshape(len(rows), -1)
    new_bytes[:, :size] = old_bytes


def _modernise(packed: LasColumns, rows: Rows, layout: Layout) -> None:
    """Copy all dimensions of points of formats 0 to 3 to points of formats 6 and 7."""
    for axis in "XYZ":
        rows[axis] = packed.rows[axis]
    for name, dimension in packed.layout.dimensions.items():
        values = dimension.get(packed.rows)
        if name == "scan_angle_rank":
            layout.dimensions["scan_angle"].set(rows, np.rint(values / DEGREES))
        else:
            layout.dimensions[name].set(rows, values)


def plan(path: Path, table: TableParts, copc: bool) -> tuple[Plan, Iterator[Table]]:
    """Return what a file will be like, and the parts of the table.

    Args:
        path: the file to write.
        table: its points; a header, if it has one, is of a LAS file.
        copc: whether the file is COPC.

    Raises:
        BadCloudError: the file cannot hold the points as they are.
    """
    parts = iter(table.parts)
    first = next(parts)
    packed = first.columns if isinstance(first.columns, LasColumns) else None
    columns = table.columns
    if packed is not None:
        columns = {name: table.columns[name] for name in packed.changes}
    if table.header is None:
        source = _new_header(table, copc or _needs_modern(table.columns))
    else:
        source = table.header
        _check(path, source, copc, packed is not None)
    layout = layout_of(source)
    if copc:
        source, layout = _modern_header(with_wkt(source), layout)
    layout, names = layout.with_columns(columns, table.form.arrays)
    header = _with_records(source, layout)
    has_waveforms = packed is not None and header.format in WAVEFORM_FORMATS
    on_new_grid = table.header is None and table.form.coordinates is not None
    return Plan(header, layout, names, has_waveforms, on_new_grid), chain([first], parts)


def _check(path: Path, header: Header, copc: bool, has_attributes: bool) -> None:
    """Reject points that a file cannot hold as they are."""
    if header.waveforms_inside and has_attributes:
        raise BadCloudError(
            "OUT: it would lose the waveforms, which are inside of IN. Move them to a .wdp file "
            "first, write .npz, or give --coordinates-only."
        )
    compressed = copc or path.suffix.lower() == ".laz"
    if compressed and header.format in WAVEFORM_FORMATS:
        raise BadCloudError(
            f"OUT: points of format {header.format} refer to waveforms, which lazrs does not "
            "write so that every reader gets them. Write .las."
        )
    if copc and header.minor > 4:
        raise BadCloudError(
            "OUT: COPC is LAS 1.4, but IN is LAS 1.5, whose time offset it cannot hold. Write .laz."
        )


def _needs_modern(columns: Mapping[str, Column]) -> bool:
    """Return whether LAS 1.4 has a dimension for a number that 1.2 has not, such as class 64."""
    old = Layout(OLD_FORMAT)
    new = Layout(MODERN[OLD_FORMAT])
    for name, values in columns.items():
        if name not in old.dimensions or name not in new.dimensions:
            continue
        if new.holds(name, values) and not old.holds(name, values):
            return True
    return False


def _new_header(table: TableParts, modern: bool) -> Header:
    """Make the header of a file that does not come from one of LAS: 1.2, or 1.4."""
    if modern:
        minor = 4
        form = MODERN[OLD_FORMAT]
        encoding = WKT
    else:
        minor = 2
        form = OLD_FORMAT
        encoding = 0
    size = HEADER_BYTES[minor]
    today = date.today()
    item = Layout(form).standard.itemsize
    extent = float(np.ptp(table.corners, axis=0).max())
    scale = max(extent, 1e-9) / 2**30
    head = bytearray(size)
    head[:4] = b"LASF"
    struct.pack_into("<H", head, 6, encoding)
    head[24:26] = bytes([1, minor])
    head[26:31] = b"OTHER"
    struct.pack_into("<3H", head, 90, today.timetuple().tm_yday, today.year, size)
    struct.pack_into("<BH", head, 104, form, item)
    struct.pack_into("<3d", head, 131, scale, scale, scale)
    struct.pack_into("<3d", head, 155, *table.corners[0])
    return Header(bytes(head))


def _modern_header(header: Header, layout: Layout) -> tuple[Header, Layout]:
    """Return a header of LAS 1.4 and a layout of format 6, 7 or 8."""
    if header.format in (6, 7, 8):
        return header, layout
    head = bytearray(header.head[:227])
    head += bytes(HEADER_BYTES[4] - len(head))
    head[25] = 4
    form = MODERN[header.format]
    struct.pack_into("<H", head, 94, len(head))
    layout = Layout(form, layout.extra)
    struct.pack_into("<BH", head, 104, form, layout.dtype.itemsize)
    return replace(header, head=bytes(head)), layout


def _with_records(header: Header, layout: Layout) -> Header:
    """Return a header for a layout, without the records of a compression and an octree."""
    left_out = {("laszip encoded", LASZIP), (COPC, 1)}
    records = []
    for record in header.records:
        if (record.user, record.number) not in left_out:
            records.append(record)
    if layout.extra != layout_of(header).extra:
        records = _with_extra(records, documented_extra(header), layout)
    head = bytearray(header.head)
    struct.pack_into("<BH", head, 104, layout.format, layout.dtype.itemsize)
    if header.waveforms_inside:  # the points that are written do not refer to them
        struct.pack_into("<H", head, 6, header.encoding & ~INSIDE)
        struct.pack_into("<Q", head, 227, 0)
    return replace(header, head=bytes(head), records=tuple(records))


def _with_extra(records: list[Record], documented: list[Extra], layout: Layout) -> list[Record]:
    """Document the extra dimensions of a layout behind those that records document.

    They are added to the last record: some readers, such as laspy, read one record only.
    """
    others = [record for record in records if not is_extra(record)]
    known = []
    if documented:
        known = [record for record in records if is_extra(record)]
    last = Record.new(SPEC, EXTRA_BYTES, b"", "Extra Bytes Record")
    if known:
        last = known.pop()
    whole_entries = len(last.data) // EXTRA.size
    data = last.data[: whole_entries * EXTRA.size]
    for extra in layout.extra[len(documented) :]:
        data += b"".join(piece.to_bytes() for piece in extra.pieces())
    return [*others, *known, replace(last, data=data)]
