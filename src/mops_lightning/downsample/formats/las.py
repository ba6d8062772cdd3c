"""LAS and LAZ files by laspy, an extra."""

from pathlib import Path
from typing import Any

import numpy as np

from mops_lightning.downsample.formats.table import (
    BadCloudError,
    Column,
    Table,
    ends_early,
    unique_names,
)
from mops_lightning.errors import UserError


def read(path: Path) -> Table:
    """Read all points with all their dimensions; coordinates are scaled and shifted."""
    laspy = laspy_for(path)
    with laspy.open(path) as file:
        announced = file.header.point_count
        try:
            cloud = file.read()
        except ValueError as error:
            raise BadCloudError(f"{path} is broken: it ends too early ({error}).") from None
    table = table_of(cloud, cloud.header)
    if len(table.points) < announced:
        raise ends_early(path, len(table.points))
    return table


def check_bounds(path: Path, table: Table, header: Any) -> None:
    """Refuse what cannot be the file's points: a broken LAZ may give any before its end is read.

    Raises:
        BadCloudError: a point lies far outside of the bounds that the head gives, if it gives any.
    """
    low, high = np.asarray(header.mins), np.asarray(header.maxs)
    far = (high - low).max()
    if far > 0 and ((table.points < low - far) | (table.points > high + far)).any():
        raise BadCloudError(f"{path} is broken: points lie far outside of the bounds in its head.")


def table_of(cloud: Any, header: Any) -> Table:
    """Make a table of laspy's points, with all dimensions of one number each."""
    points = np.stack([np.asarray(getattr(cloud, axis), np.float64) for axis in "xyz"], 1)
    names = [name for name in cloud.point_format.dimension_names if name not in "XYZ"]
    columns = {name: np.asarray(cloud[name]) for name in names}
    return Table(points, {n: c for n, c in columns.items() if c.ndim == 1}, header)


def write(path: Path, table: Table) -> None:
    """Write a LAS or LAZ file like the one that was read, or one of plain coordinates."""
    laspy = laspy_for(path)
    header: Any
    if table.head is None:
        header = laspy.LasHeader(point_format=3, version="1.2")
        spread = float(np.ptp(table.points, axis=0).max())
        header.offsets = table.points.min(0)
        header.scales = np.full(3, max(spread, 1e-9) / 2**30)
    else:
        header = laspy.LasHeader(
            point_format=table.head.point_format, version=str(table.head.version)
        )
        header.offsets, header.scales = table.head.offsets, table.head.scales
        header.vlrs = table.head.vlrs
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = table.points.T
    known = set(cloud.point_format.dimension_names)
    for name, column in unique_names(table).items():
        if name in known and _kept_exactly(cloud, name, column):
            continue
        kind = np.dtype("u1") if column.dtype.kind == "b" else column.dtype.newbyteorder("=")
        kind = np.dtype("f4") if kind == np.dtype("f2") else kind
        own = (f"{name}_" if name in known else name)[:32]
        cloud.add_extra_dim(laspy.ExtraBytesParams(name=own, type=kind))
        cloud[own] = column.astype(kind)
    cloud.write(path)


def _kept_exactly(cloud: Any, name: str, column: Column) -> bool:
    """Put a column into a dimension of LAS, if that has room for its numbers."""
    try:
        with np.errstate(all="ignore"):
            cloud[name] = column
        exact = np.array_equal(np.asarray(cloud[name]), column)
    except (OverflowError, TypeError, ValueError):
        exact = False
    if not exact:
        cloud[name] = np.zeros(len(column), np.uint8)
    return exact


def laspy_for(path: Path) -> Any:
    """Return laspy, which need not be installed.

    Raises:
        UserError: it is not.
    """
    try:
        import laspy
    except ModuleNotFoundError:
        raise UserError(
            f"{path}: LAS and LAZ need a package that is not here: "
            "pip install 'mops-lightning[las]'."
        ) from None
    return laspy
