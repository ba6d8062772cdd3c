"""A cloud as its file has it: coordinates, and columns of attributes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.errors import BadCloudError

Column = NDArray[Any]

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

    def without_attributes(self) -> "Table":
        """Return the points alone."""
        return Table(self.points, {}, self.header)


def from_array(array: NDArray[Any], names: list[str], path: Path, header: Any = None) -> Table:
    """Make a table of the columns of a plain or structured array.

    Args:
        array: ``(N, K)``, K ≥ 3, or ``(N,)`` with named fields.
        names: of the columns; must include x, y and z.
        path: for errors.
        header: see ``Table``.

    Raises:
        BadCloudError: there are no coordinates.
    """
    lower = {name.lower(): name for name in reversed(names)}
    if not {"x", "y", "z"} <= set(lower):
        raise BadCloudError(f"{path} must have columns x, y and z, got {', '.join(names)}.")

    def column(name: str) -> Column:
        return array[name] if array.dtype.names else array[:, names.index(name)]

    axes = [lower[axis] for axis in "xyz"]
    for name in axes:
        if column(name).dtype.kind not in "fiu":
            raise BadCloudError(f"{path}: {name} must be numbers, got {column(name).dtype}.")
    points = np.stack([np.asarray(column(axis), np.float64) for axis in axes], 1)
    rest = {name: column(name) for name in names if name not in axes}
    numbers = {name: c for name, c in rest.items() if c.ndim == 1 and c.dtype.kind in "fiub"}
    return Table(points, numbers, header)


def from_unnamed(array: NDArray[Any], path: Path) -> Table:
    """Make a table of an array whose first columns are x, y and z; see ``column_names``."""
    return from_array(array, column_names(array, path), path)


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
        raise BadCloudError(
            f"{path} must hold rows of x, y, z, got {array.dtype} of shape {shape}."
        )
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


def columns_to_rows(columns: list[Column]) -> NDArray[Any]:
    """Return columns ``(N,)`` as one structured array of N rows."""
    rows = np.empty(len(columns[0]), [(f"f{i}", column.dtype) for i, column in enumerate(columns)])
    for i, column in enumerate(columns):
        rows[f"f{i}"] = column
    return rows
