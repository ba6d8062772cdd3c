"""NumPy files, .npy with one array and .npz with several, and KITTI's laser scans (.bin)."""

from pathlib import Path

import numpy as np

from mops_lightning.data.formats import table as tables
from mops_lightning.data.formats.guard import BadCloudError, WholeOnlyError
from mops_lightning.filesystem import load_npz

POINTS = ("points", "xyz", "pos")
"""Names of the array of an .npz file that holds the coordinates."""

KITTI = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])
"""A row of a laser scan; its file has no header."""


def read_npy(path: Path) -> tables.Table:
    """Read one array: ``(N, K)`` numbers, x, y and z first, or ``(N,)`` rows of named fields."""
    return tables.from_array(np.load(path, allow_pickle=False), path)


def write_npy(path: Path, table: tables.Table) -> None:
    """Write ``(N, 3 + columns)`` float64."""
    with path.open("wb") as file:
        np.save(file, np.column_stack([table.points, *table.columns.values()]))


def locate_npy(path: Path) -> tables.CloudFile:
    """Find the rows of an .npy file.

    Raises:
        BadCloudError: the array does not hold points, or not one after the other.
    """
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    names, kind = tables.column_names(array, path), array.dtype
    if kind.names is None:
        if not array.flags.c_contiguous:
            raise WholeOnlyError(f"{path}: --chunk needs an array in C order, got Fortran order.")
        kind = np.dtype([(name, kind) for name in names])
    return tables.binary_file(path, array.shape[0], kind, array.offset)


def read_npz(path: Path) -> tables.Table:
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
    table = tables.from_array(arrays.pop(chosen), path)
    columns: dict[str, tables.Column] = dict(table.columns)
    for name, array in arrays.items():
        numbers = array.dtype.kind in "fiub" and array.ndim in (1, 2)
        if numbers and len(array) == len(table.points):
            columns |= tables.split_array(name, array)
    return tables.Table(table.points, columns)


def write_npz(path: Path, table: tables.Table) -> None:
    """Write ``points`` and one array for every column."""
    named = tables.unique_names(table)
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, points=table.points, **named)


def read_kitti(path: Path) -> tables.Table:
    """Read a laser scan."""
    scan = locate_kitti(path)
    return scan.parse(path, range(scan.number))


def write_kitti(path: Path, table: tables.Table) -> None:
    """Write a laser scan; without an ``intensity`` column the intensity is 0.

    Raises:
        BadCloudError: float32 would move the points.
    """
    points = tables.compact_coordinates(table)
    if points.dtype != np.float32:
        raise BadCloudError(
            f"{path}: .bin holds float32, which would move these points, far from the origin, by "
            "more than a millionth of their extent. Write .ply, .npy or .las."
        )
    intensity = table.columns.get("intensity", np.zeros(len(points)))
    path.write_bytes(np.column_stack([points, intensity]).astype("<f4").tobytes())


def locate_kitti(path: Path) -> tables.CloudFile:
    """Find the rows of a laser scan.

    Raises:
        BadCloudError: the file is not a scan.
    """
    length = path.stat().st_size
    if not length or length % KITTI.itemsize:
        raise BadCloudError(
            f"{path} is not a KITTI scan: {length} bytes are not rows of 4 float32."
        )
    return tables.binary_file(path, length // KITTI.itemsize, KITTI)
