"""A cloud as its file has it: coordinates and columns of attributes, whole or in ranges of rows."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.guard import BadCloudError, ends_early, reading
from mops_lightning.errors import UserError

Column = NDArray[Any]

PART = 500_000
"""Number of rows that are read at a time."""

RESERVED = ("x", "y", "z", "points")
"""Names that a column cannot have in a file."""


@dataclass(frozen=True)
class Table:
    """Points and their attributes.

    Attributes:
        points: ``(N, 3)`` float64 coordinates in the file's own unit.
        columns: attributes, ``(N,)`` numbers each, under the file's names. Strings, dates and lists
            are left out.
        header: what a format needs to write a file of the same kind (LAS).
    """

    points: NDArray[np.float64]
    columns: Mapping[str, Column] = field(default_factory=dict)
    header: Any = None

    def take(self, rows: NDArray[np.int64]) -> "Table":
        """Return the points in ``rows`` with their attributes."""
        columns = {name: column[rows] for name, column in self.columns.items()}
        return Table(self.points[rows], columns, self.header)

    def finite(self) -> "Table":
        """Return the points whose coordinates are all finite."""
        finite = np.isfinite(self.points).all(axis=1)
        return self if finite.all() else self.take(np.flatnonzero(finite))

    def whole_numbers(self, name: str, path: Path) -> NDArray[np.int64]:
        """Return a column of whole numbers ``(N,)``, such as the classes of points.

        Raises:
            BadCloudError: there is no such column, or it holds other numbers.
        """
        column = self.columns.get(name)
        if column is None:
            known = ", ".join(self.columns) or "none"
            raise BadCloudError(f"{path} has no column {name!r}. Its columns: {known}.")
        with np.errstate(invalid="ignore"):  # NaN is no whole number, either
            whole = column.astype(np.int64)
        if (wrong := column[whole != column]).size:
            raise BadCloudError(f"{path}: {name!r} must hold whole int64 numbers, got {wrong[0]}.")
        return whole

    def without_attributes(self) -> "Table":
        """Return the points alone."""
        return Table(self.points, {}, self.header)


def join_tables(tables: Iterable[Table]) -> Table:
    """Return the points of tables with the same columns in one, without a header."""
    filled = [table for table in tables if len(table.points)]
    if not filled:
        return Table(np.empty((0, 3)))
    columns = {n: np.concatenate([t.columns[n] for t in filled]) for n in filled[0].columns}
    return Table(np.concatenate([table.points for table in filled]), columns)


@dataclass(frozen=True)
class Area:
    """The part of a file to read: a box, and how deep to go into the octree of a COPC file.

    Attributes:
        low: lowest x, y and z; -inf for no limit.
        high: highest x, y and z, which belong to the box.
        level: deepest level of the octree, 0 for its root; None: all levels.
        resolution: distance of neighbouring points, in the file's unit, at which to stop; None: all
            levels.

    Raises:
        UserError: a value is out of range.
    """

    low: tuple[float, ...] = (-inf,) * 3
    high: tuple[float, ...] = (inf,) * 3
    level: int | None = None
    resolution: float | None = None

    def __post_init__(self) -> None:
        """Reject values out of range."""
        if self.level is not None and self.resolution is not None:
            raise UserError("give --level or --resolution, not both.")
        if self.level is not None and not 0 <= self.level < 32:
            raise UserError(f"--level must be from 0 to 31, got {self.level}.")
        if self.resolution is not None and not 0 < self.resolution < inf:
            raise UserError(f"--resolution must be a number above 0, got {self.resolution}.")

    @classmethod
    def parse(
        cls, bounds: str | None, level: int | None, resolution: float | None
    ) -> "Area | None":
        """Return the area of the options of a command line; None without any.

        Args:
            bounds: ``xmin,ymin,xmax,ymax`` or ``xmin,ymin,zmin,xmax,ymax,zmax``.
            level: see ``Area``.
            resolution: see ``Area``.
        """
        if bounds is None:
            levels = cls(level=level, resolution=resolution)
            return None if levels == cls() else levels
        numbers: list[float] = []
        with suppress(ValueError):
            numbers = [float(word) for word in bounds.split(",")]
        half = len(numbers) // 2
        low, high = numbers[:half], numbers[half:]
        if len(numbers) not in (4, 6) or not all(a < b for a, b in zip(low, high, strict=True)):
            raise UserError(
                "--bounds must be xmin,ymin,xmax,ymax or xmin,ymin,zmin,xmax,ymax,zmax with every "
                f"min below its max, got {bounds!r}."
            )
        flat = half == 2
        return cls((*low, *[-inf] * flat), (*high, *[inf] * flat), level, resolution)

    def clip(self, table: Table, path: Path) -> Table:
        """Return the points of a file that are in the box.

        Raises:
            BadCloudError: the area has levels, but the file has none.
        """
        if self.level is not None or self.resolution is not None:
            raise BadCloudError(
                f"{path}: --level and --resolution need a COPC file, which has levels of detail. "
                "Use --bounds alone, or --method voxel."
            )
        inside = ((table.points >= self.low) & (table.points <= self.high)).all(axis=1)
        return table if inside.all() else table.take(np.flatnonzero(inside))


@dataclass(frozen=True)
class CloudFile:
    """A file whose rows can be read in any range, so that it need not fit in memory.

    Attributes:
        path: the file.
        number: how many points it has, including those with non-finite coordinates.
        parse: reads a range of rows, or fewer where the file ends too early.
        header: see ``Table``; the tables that are read have none.
        area: the part of the file to read.
    """

    path: Path
    number: int
    parse: Callable[[Path, range], Table]
    header: Any = None
    area: Area | None = None

    def row_ranges(self, size: int) -> list[range]:
        """Split the rows into ranges of up to ``size``."""
        starts = range(0, self.number, size)
        return [range(start, min(start + size, self.number)) for start in starts]

    def read(self, rows: range) -> Table:
        """Read a range of rows, without the points that are not finite or outside of the area.

        Raises:
            BadCloudError: the file is missing or broken, or ends too early.
        """
        with reading(self.path):
            table = self.parse(self.path, rows)
            if len(table.points) < len(rows):
                raise ends_early(self.path, rows.start + len(table.points))
            table = table.finite()
            return table if self.area is None else self.area.clip(table, self.path)

    def read_all(self) -> Table:
        """Read all rows, range by range; see ``read``."""
        tables = [self.read(rows) for rows in self.row_ranges(PART)]
        return replace(join_tables(tables), header=self.header)


@dataclass(frozen=True)
class TableParts:
    """A table that is written part by part, so that it need not fit in memory.

    Attributes:
        parts: the table's rows, part by part; all parts have the same columns.
        number: how many points all parts have.
        corners: ``(2, 3)`` lowest and highest coordinates.
        coordinates: the type of the coordinates in formats that offer float32 and float64.
        columns: numbers of every column that show its type and range, ``(any,)`` each.
        header: see ``Table``.
    """

    parts: Iterable[Table]
    number: int
    corners: NDArray[np.float64]
    coordinates: np.dtype[Any]
    columns: Mapping[str, Column]
    header: Any = None

    @classmethod
    def whole(cls, table: Table) -> "TableParts":
        """Return a table as its only part."""
        corners = np.stack([table.points.min(0), table.points.max(0)])
        kind = compact_coordinates(table).dtype
        return cls([table], len(table.points), corners, kind, table.columns, table.header)


def binary_file(path: Path, number: int, kind: np.dtype[Any], offset: int = 0) -> CloudFile:
    """Return a file whose points are rows of a fixed number of bytes.

    Args:
        path: the file.
        number: of rows.
        kind: the data type of a row, with the names of the columns.
        offset: of the first row, in bytes.

    Raises:
        BadCloudError: the file is too short for its rows.
    """
    if not kind.itemsize or number < 0:
        raise BadCloudError(f"{path} is broken: {number} points of {kind}.")
    room = max(path.stat().st_size - offset, 0) // kind.itemsize
    if number > room:
        raise ends_early(path, room)
    return CloudFile(path, number, partial(_parse_rows, kind, offset))


def _parse_rows(kind: np.dtype[Any], offset: int, path: Path, rows: range) -> Table:
    start = offset + rows.start * kind.itemsize
    return from_array(np.fromfile(path, kind, len(rows), offset=start), path)


def from_columns(columns: Mapping[str, Column], path: Path) -> Table:
    """Make a table of columns ``(N,)``, x, y and z among them.

    Args:
        columns: in the order of the file. Strings, dates and lists are left out.
        path: for errors.

    Raises:
        BadCloudError: there are no coordinates.
    """
    lower = {name.lower(): name for name in reversed(list(columns))}
    if not {"x", "y", "z"} <= set(lower):
        raise BadCloudError(f"{path} must have columns x, y and z, got {', '.join(columns)}.")
    axes = [lower[axis] for axis in "xyz"]
    for name in axes:
        if columns[name].dtype.kind not in "fiu":
            raise BadCloudError(f"{path}: {name} must be numbers, got {columns[name].dtype}.")
    points = np.stack([np.asarray(columns[name], np.float64) for name in axes], 1)
    attributes = {
        name: column
        for name, column in columns.items()
        if name not in axes and column.ndim == 1 and column.dtype.kind in "fiub"
    }
    return Table(points, attributes)


def from_array(array: NDArray[Any], path: Path) -> Table:
    """Make a table of the columns of an array; see ``column_names``."""
    names = column_names(array, path)
    if array.dtype.names:
        return from_columns({name: array[name] for name in names}, path)
    return from_columns(dict(zip(names, array.T, strict=True)), path)


def column_names(array: NDArray[Any], path: Path) -> list[str]:
    """Return the names of an array's columns: its fields, or x, y, z, column_3 and so on.

    Args:
        array: plain or structured; its numbers are not read.
        path: for errors.

    Raises:
        BadCloudError: the array has neither rows of at least three numbers nor one row of fields
            per point.
    """
    shape, kind = array.shape, array.dtype.kind
    if array.dtype.names:
        if array.ndim != 1:
            raise BadCloudError(f"{path} must hold one row of fields per point, got {shape}.")
        return list(array.dtype.names)
    if len(shape) != 2 or shape[1] < 3 or kind not in "fiu":
        raise BadCloudError(f"{path} must hold rows of x, y, z, got {array.dtype} {shape}.")
    return ["x", "y", "z", *(f"column_{place}" for place in range(3, shape[1]))]


def split_array(name: str, values: NDArray[Any]) -> dict[str, Column]:
    """Return values ``(N,)`` as one column, or ``(N, k)`` as ``NAME_0`` to ``NAME_k-1``."""
    if values.ndim == 1:
        return {name: values}
    return {f"{name}_{place}": values[:, place] for place in range(values.shape[1])}


def unique_names(table: Table) -> dict[str, Column]:
    """Return the columns under names that a file's header can hold: unique and without spaces."""
    named: dict[str, Column] = {}
    for name, column in table.columns.items():
        plain = "_".join(name.split()) or "column"
        while plain.lower() in RESERVED or plain in named:
            plain += "_"
        named[plain] = column
    return named


def compact_coordinates(table: Table) -> NDArray[Any]:
    """Return the points as float32 if that moves none by a millionth of the cloud's extent."""
    single = table.points.astype("<f4")
    finite = np.isfinite(table.points).all(axis=1)
    lost = np.abs(single - table.points)[finite].max(initial=0.0)
    extent = np.ptp(table.points[finite], axis=0).max() if finite.any() else 0.0
    return single if lost <= 1e-6 * extent else table.points


def to_columns(table: Table) -> dict[str, Column]:
    """Return ``compact_coordinates`` as x, y and z, and the columns of ``unique_names``."""
    return dict(zip("xyz", compact_coordinates(table).T, strict=True)) | unique_names(table)


def to_rows(columns: Mapping[str, Column]) -> NDArray[Any]:
    """Return columns ``(N,)`` as a structured array of N rows, in little-endian order."""
    fields = [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()]
    rows = np.empty(len(columns["x"]), fields)
    for name, column in columns.items():
        rows[name] = column
    return rows
