"""The space of distances: coordinates and further columns of a table, scaled; and its unit."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.las.header import Header
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import did_you_mean

Space = tuple[tuple[str, float], ...]
"""Columns and their factors, x, y and z among them."""

WKT = 2112
GEO_KEYS = 34735
"""Numbers of the records of a LAS file that hold a coordinate system (LAS 1.4 R15)."""

MODEL_KEY = 1024
GEOGRAPHIC = 2
"""The key of GeoTIFF for the kind of coordinates, and its value for degrees."""


def in_space(table: Table, space: Space | None, path: Path) -> NDArray[np.float64]:
    """Return the columns ``(N, C)`` that count in distances, scaled; without a space, the points.

    Raises:
        BadCloudError: there is no such column, or it is not finite.
    """
    if space is None:
        return table.points
    axes = dict(zip("xyz", table.points.T, strict=True))
    columns = []
    for name, factor in space:
        values = axes.get(name, table.columns.get(name))
        if values is None:
            hint = did_you_mean(name, {*axes, *table.columns})
            raise BadCloudError(f"--space: {path} has no column {name!r}.{hint}")
        if not np.isfinite(values).all():
            raise BadCloudError(f"--space: {name!r} of {path} is not finite.")
        if factor > 0:
            columns.append(values.astype(np.float64) * factor)
    return np.stack(columns, axis=1)


def check_unit(header: Any, name: str, path: Path) -> None:
    """Reject a LAS file in degrees, where a distance has no meaning.

    Args:
        header: see ``Table``.
        name: of the option with the distance.
        path: the file.

    Raises:
        BadCloudError: the file has a geographic coordinate system.
    """
    if isinstance(header, Header) and _is_geographic(header):
        raise BadCloudError(
            f"{name}: the coordinates of {path} are degrees (a geographic coordinate system). "
            "Project them first, for example with PDAL, or give --m."
        )


def _is_geographic(header: Header) -> bool:
    """Return what the WKT says, which comes before GeoTIFF keys (LAS 1.4 R15)."""
    records = {}
    for record in (*header.records, *header.extended):
        records[record.number] = record.data
    if WKT in records:
        words = records[WKT].decode("utf-8", "replace").upper()
        is_projected = "PROJCS" in words or "PROJCRS" in words
        is_geographic = "GEOGCS" in words or "GEOGCRS" in words
        return is_geographic and not is_projected
    if GEO_KEYS not in records:
        return False
    data = records[GEO_KEYS]
    whole_keys = len(data) // 8
    keys = np.frombuffer(data[: whole_keys * 8], "<u2").reshape(-1, 4)
    return any(key == MODEL_KEY and value == GEOGRAPHIC for key, _, _, value in keys[1:])
