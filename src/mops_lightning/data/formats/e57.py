"""E57 files, read by pye57, an extra."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.columns import common_names
from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.isolated import isolated
from mops_lightning.data.formats.table import Column, Form, Table
from mops_lightning.errors import UserError

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
STATES = ("cartesianInvalidState", "sphericalInvalidState")

COLUMNS = {
    "intensity": "intensity",
    "colorRed": "red",
    "colorGreen": "green",
    "colorBlue": "blue",
    "rowIndex": "row",
    "columnIndex": "column",
    "returnIndex": "return_index",
    "returnCount": "return_count",
    "timeStamp": "time",
    "nor:normalX": "nx",
    "nor:normalY": "ny",
    "nor:normalZ": "nz",
}
"""Fields of a scan, and the columns of a table that hold them."""

FLOATS = ("intensity", "time", "nx", "ny", "nz")

POINTS_PER_BYTE = 8
"""Largest number of points per byte of a file: each takes a bit at least."""


def read(path: Path) -> Table:
    """Read the points of all scans at their poses; invalid points get NaN as coordinates.

    A column ``scan`` has the number of the scan where there are several.

    Raises:
        UserError: pye57 is not installed, or the file is broken.
    """
    return isolated(_parse, path)


def _parse(path: Path) -> Table:
    pye57 = _pye57(path)
    with pye57.E57(str(path)) as file:
        scans = [_scan(path, file, number) for number in range(file.scan_count)]
    scans = [scan for scan in scans if len(scan.points)]
    if not scans:
        raise BadCloudError(f"{path} holds no points.")
    names = common_names([scan.columns for scan in scans])
    columns = {name: np.concatenate([scan.columns[name] for scan in scans]) for name in names}
    left_out: set[str] = set()
    for scan in scans:
        left_out.update(scan.columns, scan.form.left_out)
    if len(scans) > 1:
        lengths = [len(scan.points) for scan in scans]
        numbers = np.arange(len(scans), dtype=np.uint16)
        columns["scan"] = np.repeat(numbers, lengths)
    points = np.concatenate([scan.points for scan in scans])
    lost = sorted(left_out.difference(columns))
    form = Form(np.dtype(np.float64), left_out=tuple(lost))
    return Table(points, columns, form=form)


def _scan(path: Path, file: Any, number: int) -> Table:
    """Return one scan, with its pose applied."""
    header = file.get_header(number)
    count = header.point_count
    if not 0 <= count <= POINTS_PER_BYTE * path.stat().st_size:
        raise BadCloudError(f"{path} is broken: it is too short for {count:,} points.")
    fields = list(header.point_fields)
    axes = CARTESIAN if CARTESIAN[0] in fields else SPHERICAL
    missing = [axis for axis in axes if axis not in fields]
    if missing:
        raise BadCloudError(f"{path}: scan {number} has no {', '.join(missing)}.")
    if not count:
        return Table(np.empty((0, 3)))
    wanted = [name for name in fields if name in (*axes, *STATES, *COLUMNS)]
    numbers = _read_fields(file, header, wanted, count)
    points = np.stack([numbers[axis] for axis in axes], 1)
    if axes is SPHERICAL:
        points = _cartesian(points)
    if header.has_pose():
        points = file.to_global(points, header.rotation, header.translation)
    for state in STATES:
        if state in numbers:
            points[numbers[state] != 0] = np.nan
    columns = {
        COLUMNS[name]: _narrow(COLUMNS[name], values)
        for name, values in numbers.items()
        if name in COLUMNS
    }
    left_out = tuple(name for name in fields if name not in wanted)
    return Table(points, columns, form=Form(left_out=left_out))


def _read_fields(file: Any, header: Any, names: list[str], count: int) -> dict[str, Column]:
    """Return the numbers of fields as float64, which holds all that scanners write."""
    from pye57 import libe57

    numbers = {name: np.empty(count) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name, values in numbers.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, values, count, True, True))
    found = header.points.reader(buffers).read()
    if found < count:
        raise ValueError(f"a scan ends after {found} of {count} points")
    return numbers


def _cartesian(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x, y and z of ranges, azimuths and elevations, angles in radians."""
    distance, azimuth, elevation = points.T
    flat = distance * np.cos(elevation)
    x = flat * np.cos(azimuth)
    y = flat * np.sin(azimuth)
    z = distance * np.sin(elevation)
    return np.stack([x, y, z], 1)


def _narrow(name: str, values: NDArray[np.float64]) -> Column:
    """Return numbers in the smallest usual data type that holds them exactly."""
    kinds = (np.float32,) if name in FLOATS else (np.uint8, np.uint16, np.int32)
    for kind in kinds:
        with np.errstate(all="ignore"):
            narrow = values.astype(kind)
        if np.array_equal(narrow, values, equal_nan=True):
            return narrow
    return values


def _pye57(path: Path) -> Any:
    """Return pye57, or raise an error that says how to install it."""
    try:
        import pye57
    except ModuleNotFoundError:
        raise UserError(f"{path}: E57 needs pye57: pip install 'mops-lightning[e57]'.") from None
    return pye57
