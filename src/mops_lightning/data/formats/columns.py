"""Columns of a table: from the arrays of a file, and to rows of types that a format has."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.guard import BadCloudError, CannotHoldError
from mops_lightning.data.formats.table import Column, Form, Table

RESERVED = ("x", "y", "z", "points")
"""Names that a column cannot have in a file."""

LARGEST_WHOLE = 2**53
"""Up to here float64 holds every whole number."""


def from_columns(columns: Mapping[str, Column], path: Path, layout: Any = None) -> Table:
    """Make a table of columns, x, y and z among them, in capitals or not.

    Args:
        columns: ``(N,)``, in the order of the file. Strings, dates and lists are left out.
        path: for errors.
        layout: see ``Form``.

    Raises:
        BadCloudError: there are no coordinates, or float64 does not hold them.
    """
    names_from_last = reversed(list(columns))
    name_of = {name.lower(): name for name in names_from_last}
    if not {"x", "y", "z"} <= name_of.keys():
        given = ", ".join(columns)
        raise BadCloudError(f"{path} must have columns x, y and z, got {given}.")
    axes = [name_of["x"], name_of["y"], name_of["z"]]
    for name in axes:
        _check_coordinates(name, columns[name], path)
    coordinates = [np.asarray(columns[name], np.float64) for name in axes]
    points = np.stack(coordinates, 1)
    kinds = [columns[name].dtype for name in axes]
    attributes: dict[str, Column] = {}
    left_out = []
    for name, column in columns.items():
        if name in axes:
            continue
        if is_number_column(column):
            attributes[name] = in_native_order(column)
        else:
            left_out.append(name)
    form = Form(np.result_type(*kinds), left_out=tuple(left_out), layout=layout)
    return Table(points, attributes, form=form)


def _check_coordinates(name: str, column: Column, path: Path) -> None:
    kind = column.dtype
    if kind.kind not in "fiu":
        raise BadCloudError(f"{path}: {name} must be numbers, got {kind}.")
    if not holds_exactly(np.dtype(np.float64), column):
        raise BadCloudError(f"{path}: {name} has numbers that float64 does not hold exactly.")


def common_names(parts: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names that all parts have, in the order of the first."""
    return [name for name in parts[0] if all(name in part for part in parts)]


def is_number_column(column: Column) -> bool:
    """Return whether an array has one number, or truth value, per point."""
    return column.ndim == 1 and column.dtype.kind in "fiub"


def in_native_order(column: Column) -> Column:
    """Return a column in the byte order of this machine: torch reads no other."""
    native = column.dtype.newbyteorder("=")
    return column.astype(native, copy=False)


def from_array(array: NDArray[Any], path: Path, layout: Any = None) -> Table:
    """Make a table of the columns of an array; see ``column_names``."""
    names = column_names(array, path)
    if array.dtype.names:
        columns = {name: array[name] for name in names}
    else:
        columns = dict(zip(names, array.T, strict=True))
    return from_columns(columns, path, layout)


def column_names(array: NDArray[Any], path: Path) -> list[str]:
    """Return the names of an array's columns: its fields, or x, y, z, column_3 and so on.

    Args:
        array: plain or structured; its numbers are not read.
        path: for errors.

    Raises:
        BadCloudError: the array has neither rows of at least three numbers nor one row of fields
            per point.
    """
    shape = array.shape
    kind = array.dtype
    if kind.names:
        if array.ndim != 1:
            raise BadCloudError(f"{path} must hold one row of fields per point, got {shape}.")
        return list(kind.names)
    is_rows = len(shape) == 2 and shape[1] >= 3
    if not is_rows or kind.kind not in "fiu":
        raise BadCloudError(f"{path} must hold rows of x, y, z, got {kind} {shape}.")
    return unnamed(shape[1])


def unnamed(number: int) -> list[str]:
    """Return the names of columns without names: x, y, z, column_3 and so on."""
    others = [f"column_{column}" for column in range(3, number)]
    return ["x", "y", "z", *others]


def split_array(name: str, values: NDArray[Any]) -> dict[str, Column]:
    """Return values ``(N,)`` or ``(N, 1)`` as one column, ``(N, k)`` as ``NAME_0`` and so on."""
    if values.ndim == 1:
        return {name: values}
    number = values.shape[1]
    if number == 1:
        return {name: values[:, 0]}
    return {f"{name}_{place}": values[:, place] for place in range(number)}


def unique_names(table: Table) -> dict[str, Column]:
    """Return the columns under names that a file's header can hold: unique and without spaces."""
    named: dict[str, Column] = {}
    for name, column in table.columns.items():
        plain = "_".join(name.split()) or "column"
        while plain.lower() in RESERVED or plain in named:
            plain += "_"
        named[plain] = column
    return named


def holds_exactly(kind: np.dtype[Any], column: Column) -> bool:
    """Return whether a data type holds every number of a column."""
    if not len(column) or column.dtype.kind == "b":
        return True
    if column.dtype.kind == "f":
        if np.can_cast(column.dtype, kind):
            return True
        return changed_numbers(column, kind) == 0
    least, most = _whole_numbers_of(kind)
    # Compared as Python's integers, which do not overflow.
    smallest = int(column.min())
    largest = int(column.max())
    return least <= smallest and largest <= most


def _whole_numbers_of(kind: np.dtype[Any]) -> tuple[int, int]:
    """Return the smallest and largest number between which a data type holds all whole ones."""
    if kind.kind == "f":  # numpy calls every cast from int64 to float64 safe
        bits = np.finfo(kind).nmant + 1
        most = min(LARGEST_WHOLE, 2**bits)
        return -most, most
    limits = np.iinfo(kind)
    return limits.min, limits.max


def changed_numbers(column: Column, kind: np.dtype[Any]) -> int:
    """Return how many numbers of a column another data type would change."""
    with np.errstate(all="ignore"):
        back = column.astype(kind).astype(column.dtype)
    same = back == column
    if column.dtype.kind == "f":
        is_still_nan = np.isnan(column) & np.isnan(back)
        same |= is_still_nan
    return int((~same).sum())


WIDER = {
    "f": ("f4", "f8"),
    "i": ("i4", "u4", "i8", "f8"),
    "u": ("u4", "u8", "f8"),
}
"""Data types that are tried for a column whose own type a format does not have."""


def fitting_type(name: str, column: Column, allowed: Iterable[str], suffix: str) -> np.dtype[Any]:
    """Return a column's own data type, or one that holds its numbers exactly.

    Args:
        name: of the column, for the error.
        column: its numbers, or at least the smallest and the largest one.
        allowed: the data types that a format has, such as ``i4``.
        suffix: of the format, for the error.

    Raises:
        CannotHoldError: no data type of the format holds the numbers.
    """
    if column.dtype.kind == "b":
        own = np.dtype("u1")
    else:
        own = in_native_order(column).dtype
    kinds = [np.dtype(kind) for kind in allowed]
    if own in kinds:
        return own
    for wider in map(np.dtype, WIDER[own.kind]):
        if wider in kinds and holds_exactly(wider, column):
            return wider
    if own.kind == "f":  # longdouble, with more digits than any format has
        return np.dtype(np.float64)
    others = [other for other in (".npz", ".las") if other != suffix]
    formats = " or ".join(others)
    raise CannotHoldError(
        f"{suffix} has no type for {name!r}, whole numbers of 64 bits up to "
        f"{int(column.max())}. Write {formats}, or leave all columns out by "
        "--coordinates-only."
    )


def floating(kind: np.dtype[Any]) -> np.dtype[Any]:
    """Return float32 or float64, whichever holds all numbers of a data type up to 2**53."""
    if np.can_cast(kind, np.float32):
        return np.dtype(np.float32)
    return np.dtype(np.float64)


def to_rows(columns: Mapping[str, Column]) -> NDArray[Any]:
    """Return columns ``(N,)`` as a structured array of N rows, in little-endian order."""
    fields = []
    for name, column in columns.items():
        fields.append((name, column.dtype.newbyteorder("<")))
    first = next(iter(columns.values()))
    rows = np.empty(len(first), fields)
    for name, column in columns.items():
        rows[name] = column
    return rows
