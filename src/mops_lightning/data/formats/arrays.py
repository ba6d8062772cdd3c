"""NumPy files: .npy with one array, .npz with an array of points and others."""

from pathlib import Path
from typing import Any

import numpy as np

from mops_lightning.data.formats.cloud_file import BinaryCloudFile
from mops_lightning.data.formats.errors import BadCloudError
from mops_lightning.data.formats.table import (
    Column,
    Table,
    column_names,
    from_unnamed,
    unique_names,
)
from mops_lightning.errors import one_line
from mops_lightning.filesystem import load_npz

POINTS = ("points", "xyz", "pos")
"""Names of the array of an .npz file that holds the coordinates."""


def read_npy(path: Path) -> Table:
    """Read one array: ``(N, K)`` numbers, x, y and z first, or ``(N,)`` rows of named fields."""
    return from_unnamed(_load_npy(path), path)


def write_npy(path: Path, table: Table) -> None:
    """Write ``(N, 3 + columns)`` float64."""
    with path.open("wb") as file:
        np.save(file, np.column_stack([table.points, *table.columns.values()]))


def locate_npy(path: Path) -> BinaryCloudFile:
    """Find the rows of an .npy file.

    Raises:
        BadCloudError: the array does not hold points, or not one after the other.
    """
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    names, kind = column_names(array, path), array.dtype
    if kind.names is None:
        if not array.flags.c_contiguous:
            raise BadCloudError(f"{path}: --chunk needs an array in C order, got Fortran order.")
        kind = np.dtype([(name, kind) for name in names])
    return BinaryCloudFile(path=path, number=array.shape[0], kind=kind, offset=array.offset)


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
        raise BadCloudError(
            f"{path} has no array named points, got {', '.join(arrays) or 'no arrays'}."
        )
    table = from_unnamed(arrays[chosen], path)
    columns: dict[str, Column] = dict(table.columns)
    for name, array in arrays.items():
        if name == chosen or array.ndim == 0 or len(array) != len(table.points):
            continue
        if array.dtype.kind not in "fiub":
            continue
        if array.ndim == 1:
            columns[name] = array
        elif array.ndim == 2:
            columns |= {f"{name}_{place}": array[:, place] for place in range(array.shape[1])}
    return Table(table.points, columns)


def write_npz(path: Path, table: Table) -> None:
    """Write ``points`` and one array for every column."""
    named = unique_names(table)
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, points=table.points, **named)


def _load_npy(path: Path) -> Any:
    try:
        return np.load(path, allow_pickle=False)
    except Exception as error:
        raise BadCloudError(f"{path} is broken: {one_line(error)}.") from None
