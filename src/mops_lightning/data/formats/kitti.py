"""Laser scans of KITTI (.bin): rows of float32 x, y, z, intensity, without a header."""

from pathlib import Path

import numpy as np

from mops_lightning.data.formats.cloud_file import BinaryCloudFile
from mops_lightning.data.formats.errors import BadCloudError
from mops_lightning.data.formats.table import Table, compact_coordinates

ROW = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])


def read(path: Path) -> Table:
    """Read a scan."""
    scan = locate(path)
    return scan.read_all(range(scan.number))


def write(path: Path, table: Table) -> None:
    """Write a scan; without an ``intensity`` column the intensity is 0.

    Raises:
        BadCloudError: float32 would move the points.
    """
    points = compact_coordinates(table)
    if points.dtype != np.float32:
        raise BadCloudError(
            f"{path}: .bin holds float32, which would move these points, far from the origin, by "
            "more than a millionth of their extent. Write .ply, .npy or .las."
        )
    intensity = table.columns.get("intensity", np.zeros(len(points)))
    path.write_bytes(np.column_stack([points, intensity]).astype("<f4").tobytes())


def locate(path: Path) -> BinaryCloudFile:
    """Find the rows of a scan.

    Raises:
        BadCloudError: the file is not a scan.
    """
    length = path.stat().st_size
    if not length or length % ROW.itemsize:
        raise BadCloudError(
            f"{path} is not a KITTI scan: {length} bytes are not rows of four float32 numbers."
        )
    return BinaryCloudFile(path=path, number=length // ROW.itemsize, kind=ROW)
