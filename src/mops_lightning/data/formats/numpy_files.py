"""NumPy files: .npy with one array and .npz with several."""

import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.cloud_file import CloudFile, binary_file
from mops_lightning.data.formats.columns import (
    column_names,
    from_array,
    holds_exactly,
    in_native_order,
    split_array,
    to_rows,
    unique_names,
)
from mops_lightning.data.formats.guard import BadCloudError, WholeOnlyError
from mops_lightning.data.formats.table import Column, Table
from mops_lightning.filesystem import load_npz

POINTS = ("points", "xyz", "pos", "positions")
"""Names of the array of an .npz file that holds the coordinates."""


@dataclass(frozen=True)
class NpzForm:
    """The name of the array with the points in an .npz file."""

    points: str = POINTS[0]


def read_npy(path: Path) -> Table:
    """Read one array: ``(N, K)`` numbers, x, y and z first, or ``(N,)`` rows of named fields."""
    array = np.load(path, allow_pickle=False)
    return from_array(array, path)


def write_npy(path: Path, table: Table) -> list[str]:
    """Write ``(N, 3 + columns)`` numbers of one data type, or rows of named fields.

    Returns:
        The names of the columns, which a plain array does not hold; or why the file has rows of
        fields, because no data type holds the numbers of all columns.
    """
    points = table.stored_coordinates()
    columns: dict[str, Column] = dict(zip("xyz", points.T, strict=True))
    columns |= unique_names(table)
    kind = np.result_type(*columns.values())
    is_plain = all(holds_exactly(kind, column) for column in columns.values())
    with path.open("wb") as file:
        if is_plain:
            shape = (len(points), len(columns))
            array = np.empty(shape, kind)
            for number, column in enumerate(columns.values()):
                array[:, number] = column
            np.save(file, array)
            return _lost_names(table)
        np.save(file, to_rows(columns))
    return ["rows of named fields, because no data type holds the numbers of all columns"]


def _lost_names(table: Table) -> list[str]:
    """Return a note of the names of columns that a plain array does not hold."""
    if all(name.startswith("column_") for name in table.columns):
        return []
    names = ", ".join(table.columns)
    return [f"its columns are x, y, z, {names}, without names in the file"]


def locate_npy(path: Path) -> CloudFile:
    """Find the rows of an .npy file.

    Raises:
        BadCloudError: the array does not hold points, or not one after the other.
    """
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    names = column_names(array, path)
    kind = array.dtype
    if kind.names is None:
        if not array.flags.c_contiguous:
            raise WholeOnlyError(f"{path}: --chunk needs an array in C order, got Fortran order.")
        kind = np.dtype([(name, kind) for name in names])
    return binary_file(path, array.shape[0], kind, array.offset)


def read_npz(path: Path) -> Table:
    """Read the array named as in ``POINTS``, or the only one; the rest are attributes.

    Raises:
        UserError: the file is broken, or no array is the points.
    """
    arrays = load_npz(path)
    name_of_points = _name_of_points(arrays, path)
    table = from_array(arrays.pop(name_of_points), path)
    columns: dict[str, Column] = dict(table.columns)
    grouped: dict[str, tuple[str, ...]] = {}
    left_out = list(table.form.left_out)
    for name, array in arrays.items():
        if not _is_attribute(array, len(table.points)):
            left_out.append(name)
            continue
        of_array = split_array(name, in_native_order(array))
        if array.ndim == 2:
            grouped[name] = tuple(of_array)
        columns |= of_array
    form = replace(
        table.form,
        arrays=grouped,
        left_out=tuple(left_out),
        layout=NpzForm(name_of_points),
    )
    return replace(table, columns=columns, form=form)


def _name_of_points(arrays: dict[str, NDArray[Any]], path: Path) -> str:
    """Return the name of the array with the coordinates.

    Raises:
        BadCloudError: there is none.
    """
    for name in POINTS:
        if name in arrays:
            return name
    if len(arrays) == 1:
        return next(iter(arrays))
    names = ", ".join(arrays) or "none"
    raise BadCloudError(f"{path} has no array named points, got {names}.")


def _is_attribute(array: NDArray[Any], number: int) -> bool:
    """Return whether an array has one or several numbers per point."""
    is_number = array.dtype.kind in "fiub"
    return is_number and array.ndim in (1, 2) and len(array) == number


def write_npz(path: Path, table: Table) -> None:
    """Write the points, and one array for every column or array of columns."""
    form = table.form.layout
    if not isinstance(form, NpzForm):
        form = NpzForm()
    coordinates = table.stored_coordinates()
    arrays: dict[str, NDArray[Any]] = {form.points: coordinates}
    for name, columns in joined_arrays(table).items():
        own = name
        while own in arrays:
            own += "_"
        arrays[own] = columns
    # numpy.savez takes no array named "file".
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, array in arrays.items():
            with packed.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def joined_arrays(table: Table) -> dict[str, NDArray[Any]]:
    """Return columns ``(N,)``, and arrays ``(N, k)`` of the columns that were one in the file."""
    array_of: dict[str, str] = {}
    for array, names in table.form.arrays.items():
        if _is_whole(table, names):
            array_of |= dict.fromkeys(names, array)
    joined: dict[str, NDArray[Any]] = {}
    for name, column in table.columns.items():
        if name not in array_of:
            joined[name] = column
            continue
        array = array_of[name]
        if array not in joined:
            members = table.form.arrays[array]
            of_array = [table.columns[member] for member in members]
            joined[array] = np.stack(of_array, 1)
    return joined


def _is_whole(table: Table, names: tuple[str, ...]) -> bool:
    """Return whether a table has all columns of an array, of one data type."""
    if not all(name in table.columns for name in names):
        return False
    kinds = {table.columns[name].dtype for name in names}
    return len(kinds) == 1
