"""A cloud as its file has it: coordinates and columns of attributes."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.guard import BadCloudError

Column = NDArray[Any]


@dataclass(frozen=True)
class Form:
    """How a file stores its rows, so that a file of the same kind can be written like it.

    Attributes:
        coordinates: data type of x, y and z; None: new points.
        arrays: names of arrays with several numbers per point, and the columns of each.
        left_out: names of columns and arrays that a table cannot hold, such as strings and dates.
        layout: what one format needs besides, such as the separator of a text file.
    """

    coordinates: np.dtype[Any] | None = None
    arrays: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    layout: Any = None


class PackedColumns(Mapping[str, Column]):
    """Columns that stay packed as in their file, so that a writer of its format loses nothing."""

    @abstractmethod
    def take(self, rows: NDArray[np.int64]) -> "PackedColumns":
        """Return the columns of some points."""

    @abstractmethod
    def replaced(self, columns: Mapping[str, Column]) -> "PackedColumns":
        """Return the columns with others in their place, or beside them."""

    @abstractmethod
    def joined(self, others: "Sequence[Any]") -> "PackedColumns":
        """Return these columns followed by those of other points of the same file."""


@dataclass(frozen=True)
class Table:
    """Points and their attributes.

    Attributes:
        points: ``(N, 3)`` float64 coordinates in the file's own unit.
        columns: attributes, ``(N,)`` numbers each, under the file's names.
        header: what a format needs to write a file of the same kind (LAS).
        form: how the file stores the rows.
    """

    points: NDArray[np.float64]
    columns: Mapping[str, Column] = field(default_factory=dict)
    header: Any = None
    form: Form = Form()

    def take(self, rows: NDArray[np.int64]) -> "Table":
        """Return the points in ``rows`` with their attributes."""
        columns: Mapping[str, Column]
        if isinstance(self.columns, PackedColumns):
            columns = self.columns.take(rows)
        else:
            columns = {name: column[rows] for name, column in self.columns.items()}
        return replace(self, points=self.points[rows], columns=columns)

    def with_columns(self, columns: Mapping[str, Column]) -> "Table":
        """Return the points with columns in place of those of the same name, or beside them."""
        if isinstance(self.columns, PackedColumns):
            return replace(self, columns=self.columns.replaced(columns))
        return replace(self, columns={**self.columns, **columns})

    def finite(self) -> "Table":
        """Return the points whose coordinates are all finite."""
        finite = np.isfinite(self.points).all(axis=1)
        if finite.all():
            return self
        return self.take(np.flatnonzero(finite))

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
        form = Form(self.form.coordinates, layout=self.form.layout)
        return Table(self.points, {}, self.header, form)

    def stored_coordinates(self) -> NDArray[Any]:
        """Return the points in the data type of their file, or one that holds them exactly."""
        kind = self.form.coordinates or np.dtype(np.float32)
        with np.errstate(all="ignore"):
            stored = self.points.astype(kind.newbyteorder("="))
        same = np.array_equal(stored, self.points, equal_nan=stored.dtype.kind == "f")
        if same:
            return stored
        return self.points


def join_tables(tables: Iterable[Table]) -> Table:
    """Return the points of tables with the same columns in one, without a header."""
    filled = [table for table in tables if len(table.points)]
    if not filled:
        return Table(np.empty((0, 3)))
    first = filled[0]
    points = np.concatenate([table.points for table in filled])
    columns: Mapping[str, Column]
    if isinstance(first.columns, PackedColumns):
        columns = first.columns.joined([table.columns for table in filled[1:]])
    else:
        columns = {
            name: np.concatenate([table.columns[name] for table in filled])
            for name in first.columns
        }
    return Table(points, columns, form=first.form)


@dataclass(frozen=True)
class TableParts:
    """A table that is written part by part, so that it need not fit in memory.

    Attributes:
        parts: the table's rows, part by part; all parts have the same columns.
        number: how many points all parts have.
        corners: ``(2, 3)`` lowest and highest coordinates.
        coordinates: a data type that holds all coordinates exactly.
        columns: numbers of every column that show its type and range, ``(any,)`` each.
        header: see ``Table``.
        form: see ``Table``.
    """

    parts: Iterable[Table]
    number: int
    corners: NDArray[np.float64]
    coordinates: np.dtype[Any]
    columns: Mapping[str, Column]
    header: Any = None
    form: Form = Form()

    @classmethod
    def whole(cls, table: Table) -> "TableParts":
        """Return a table as its only part."""
        corners = np.stack([table.points.min(0), table.points.max(0)])
        kind = table.stored_coordinates().dtype
        return cls(
            [table], len(table.points), corners, kind, table.columns, table.header, table.form
        )
