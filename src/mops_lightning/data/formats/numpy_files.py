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
    return from_array(np.load(path, allow_pickle=False), path)


def write_npy(path: Path, table: Table) -> list[str]:
    """Write ``(N, 3 + columns)`` numbers of one data type, or rows of named fields.

    Returns:
        The names of the columns, which a plain array does not hold; or why the file has rows of
        fields, because no data type holds the numbers of all columns.
    """
    points = table.stored_coordinates()
    columns = table.columns.values()
    kind = np.result_type(points, *columns)
    with path.open("wb") as file:
        if all(holds_exactly(kind, column) for column in (*points.T, *columns)):
            array = np.empty((len(points), 3 + len(columns)), kind)
            array[:, :3] = points
            for place, column in enumerate(columns, 3):
                array[:, place] = column
            np.save(file, array)
            return _lost_names(table)
        named: dict[str, Column] = dict(zip("xyz", points.T, strict=True)) | unique_names(table)
        np.save(file, to_rows(named))
    return ["rows of named fields, because no data type holds the numbers of all columns"]


def _lost_names(table: Table) -> list[str]:
    """Return a note of the names of columns that a plain array does not hold."""
    if all(name.startswith("column_") for name in table.columns):
        return []
    return [f"its columns are x, y, z, {', '.join(table.columns)}, without names in the file"]


def locate_npy(path: Path) -> CloudFile:
    """Find the rows of an .npy file.

    Raises:
        BadCloudError: the array does not hold points, or not one after the other.
    """
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    names, kind = column_names(array, path), array.dtype
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
    chosen = next((name for name in POINTS if name in arrays), None)
    if chosen is None and len(arrays) == 1:
        (chosen,) = arrays
    if chosen is None:
        raise BadCloudError(f"{path} has no array named points, got {', '.join(arrays) or 'none'}.")
    table = from_array(arrays.pop(chosen), path)
    columns: dict[str, Column] = dict(table.columns)
    grouped: dict[str, tuple[str, ...]] = {}
    left_out = list(table.form.left_out)
    for name, array in arrays.items():
        if not _is_attribute(array, len(table.points)):
            left_out.append(name)
            continue
        parts = split_array(name, in_native_order(array))
        if array.ndim == 2:
            grouped[name] = tuple(parts)
        columns |= parts
    form = replace(table.form, arrays=grouped, left_out=tuple(left_out), layout=NpzForm(chosen))
    return replace(table, columns=columns, form=form)


def _is_attribute(array: NDArray[Any], number: int) -> bool:
    """Return whether an array has one or several numbers per point."""
    return array.dtype.kind in "fiub" and array.ndim in (1, 2) and len(array) == number


def write_npz(path: Path, table: Table) -> None:
    """Write the points, and one array for every column or array of columns."""
    layout = table.form.layout
    form = layout if isinstance(layout, NpzForm) else NpzForm()
    arrays: dict[str, NDArray[Any]] = {form.points: table.stored_coordinates()}
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
    array_of = {part: name for name, parts in table.form.arrays.items() for part in parts}
    joined: dict[str, NDArray[Any]] = {}
    for name, column in table.columns.items():
        array = array_of.get(name)
        parts = table.form.arrays.get(array or "", ())
        kinds = {table.columns[part].dtype for part in parts if part in table.columns}
        complete = all(part in table.columns for part in parts) and len(kinds) == 1
        if array is None or not complete:
            joined[name] = column
        elif array not in joined:
            joined[array] = np.stack([table.columns[part] for part in parts], 1)
    return joined
