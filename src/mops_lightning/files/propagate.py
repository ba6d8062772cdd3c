"""The way back in files: the map of a downsampled file, and columns of a sample for all points."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats import guard
from mops_lightning.data.formats.cloud_file import PART
from mops_lightning.data.formats.registry import READERS, open_cloud_file, read_points, write
from mops_lightning.data.formats.table import Column, Table, TableParts
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.files.engine import with_progress
from mops_lightning.filesystem import atomic_write
from mops_lightning.ops.propagation import PropagationMap, mapper, propagate, propagation_map

Points = NDArray[np.float64]

PACKED_COLOURS = ("rgb", "rgba")
"""Columns of PCD files with a colour in the bytes of a number."""


def write_map(path: Path, points: Points, sampled: Points, k: int) -> None:
    """Write a map that ``mops_lightning.propagate`` reads.

    Args:
        path: the .npz file.
        points: ``(N, 3)``; points that are not finite get row −1.
        sampled: ``(m, 3)``.
        k: number of sampled points per point, at most m.
    """
    is_finite = np.isfinite(points).all(1)
    near = propagation_map(points[is_finite], sampled, k)
    rows = np.full((len(points), k), -1, np.int32)
    rows[is_finite] = near.rows.numpy()
    arrays: dict[str, Any] = {}
    arrays["rows"] = rows
    arrays["m"] = len(sampled)
    if k > 1:  # the weight of one point is 1
        weights = np.zeros((len(points), k), np.float32)
        weights[is_finite] = near.weights.numpy()
        arrays["weights"] = weights
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def propagate_file(
    small: Path,
    big: Path,
    target: Path,
    fields: list[str],
    k: int = 1,
    mean: bool = False,
    columns: Sequence[str] | None = None,
) -> int:
    """Carry columns of a sample to all points of a file.

    Files of a format in ``registry.CHUNKED`` are read part by part.

    Args:
        small: the sample, which has the columns.
        big: all points.
        target: the file to write, of a format in ``registry.PART_WRITERS``: all finite points of
            ``big`` with its columns and these.
        fields: names of the columns.
        k: number of sampled points per point; see ``mops_lightning.propagate``.
        mean: average whole numbers, too.
        columns: names of the columns of .bin files; None: those that their names imply.

    Returns:
        The number of points written.

    Raises:
        UserError: a file is broken, or the sample lacks a column.
    """
    sample = _read(small, columns).finite()
    carried: dict[str, Column] = {}
    for name in fields:
        if name not in sample.columns:
            hint = did_you_mean(name, sample.columns)
            raise UserError(f"--field: {small} has no column {name!r}.{hint}")
        carried[name] = sample.columns[name]
    most = len(sample.points)
    if not 1 <= k <= most:
        raise UserError(f"--k must be from 1 to the {most} points of {small}, got {k}.")
    map_part = mapper(sample.points, k)

    def carry(table: Table) -> Table:
        near = map_part(table.points)
        of_part = {}
        for name, values in carried.items():
            of_part[name] = _carried(name, values, near, mean)
        return table.with_columns(of_part)

    tables = _tables(big, columns)
    form = _measure(big, tables("measuring"))
    parts = (carry(table) for table in tables("propagating"))
    columns_of_both = {**form.columns, **carried}
    write(target, replace(form, parts=parts, columns=columns_of_both))
    return form.number


def _carried(name: str, values: Column, near: PropagationMap, mean: bool) -> Column:
    """Return the values of all points; packed colours are averaged channel by channel.

    Raises:
        UserError: packed colours to average have another data type than 32 bits.
    """
    has_several = near.rows.shape[-1] > 1
    is_averaged = has_several and (mean or values.dtype.kind == "f")
    if name not in PACKED_COLOURS or not is_averaged:
        return np.asarray(propagate(values, near, mean))
    if values.dtype.itemsize != 4:
        raise UserError(
            f"--field {name}: only packed colours of 32 bits can be averaged, got "
            f"{values.dtype}. Leave --k out."
        )
    colours = np.ascontiguousarray(values)
    channels = colours.view(np.uint8).reshape(-1, 4)
    averaged = np.ascontiguousarray(propagate(channels, near, mean=True))
    packed = averaged.view(values.dtype)
    return packed[:, 0]


def _read(path: Path, columns: Sequence[str] | None) -> Table:
    """Read a cloud; a mesh has no points that could be matched."""
    if path.suffix.lower() not in READERS:
        endings = ", ".join(READERS)
        raise guard.BadCloudError(f"{path} must end in {endings}.")
    with guard.reading(path):
        table = read_points(path, columns)
    if table is None or not len(table.finite().points):
        raise guard.BadCloudError(f"{path} must be a cloud of at least one point.")
    return table


def _tables(path: Path, columns: Sequence[str] | None) -> Callable[[str], Iterable[Table]]:
    """Return a function of a title that reads a file's finite points, in parts if possible."""
    try:
        file = open_cloud_file(path, None, columns)
    except guard.WholeOnlyError:  # for example ascii PLY
        whole = _read(path, columns).finite()
        return lambda title: [whole]
    ranges = file.row_ranges(PART)

    def read(title: str) -> Iterator[Table]:
        for rows in with_progress(ranges, title, len(ranges)):
            table = file.read(rows)
            if len(table.points):
                yield replace(table, header=file.header)

    return read


def _measure(path: Path, tables: Iterable[Table]) -> TableParts:
    """Return the form of a table that is written in parts, without its parts.

    Raises:
        BadCloudError: there are no points.
    """
    number = 0
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    first: Table | None = None
    columns: dict[str, Column] = {}
    for table in tables:
        if first is None:
            first = table
            columns = dict(table.columns)
        for name, column in table.columns.items():
            with_extremes = [columns[name], _extremes(column)]
            columns[name] = np.concatenate(with_extremes)
        guard.check_coordinates(path, table.points)
        number += len(table.points)
        low = np.minimum(low, table.points.min(0))
        high = np.maximum(high, table.points.max(0))
    if first is None:
        raise guard.BadCloudError(f"{path} holds no points.")
    return TableParts(
        parts=[],
        number=number,
        corners=np.stack([low, high]),
        coordinates=first.form.coordinates or np.dtype(np.float64),
        columns=columns,
        header=first.header,
        form=first.form,
    )


def _extremes(column: Column) -> Column:
    """Return the lowest and the highest number, and the one farthest from a whole number."""
    fraction = np.abs(column - np.rint(column))
    rows = [column.argmin(), column.argmax(), fraction.argmax()]
    return column[rows]
