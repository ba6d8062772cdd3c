"""Sorting the points of a file into buckets of neighbouring points that fit in memory."""

import itertools
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.cloud_file import CloudFile
from mops_lightning.data.formats.table import Table
from mops_lightning.downsample_files.large import Engine
from mops_lightning.downsample_files.tiled import ROW

Points = NDArray[np.float64]

SAMPLED = 2**19
"""Points from which the borders of the buckets are computed, at least."""

STORED = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), (ROW, "<i8")])


class Extent(NamedTuple):
    """The number of points with finite coordinates, a regular sample, and the lowest corner."""

    number: int
    sample: Points
    low: Points


@dataclass(frozen=True, kw_only=True)
class Buckets(CloudFile):
    """The points of a file in the order of its buckets; ``path`` is a folder of one file each.

    Attributes:
        parts: the range of every bucket.
    """

    parts: tuple[range, ...]

    def _parse(self, rows: range) -> Table:
        data = np.fromfile(self.path / f"{self.parts.index(rows)}.bin", STORED)
        points = np.stack([data[axis] for axis in "xyz"], 1)
        return Table(points, {ROW: data[ROW]})


def extent_of(whole: CloudFile, size: int, engine: Engine) -> Extent:
    """Read a file once and return its extent.

    Args:
        whole: the file.
        size: rows to read at a time.
        engine: processes the ranges.
    """
    cloud, row_ranges = replace(whole, header=None), whole.row_ranges(size)
    step = max(whole.number // SAMPLED, 1)
    parts = list(engine("extent", _extent, cloud, row_ranges, step))
    lows = [part.low for part in parts if part.number]
    low = np.min(lows, axis=0) if lows else np.zeros(3)
    sample = np.concatenate([part.sample for part in parts])
    return Extent(sum(part.number for part in parts), sample, low)


def _extent(cloud: CloudFile, rows: range, step: int) -> Extent:
    points = cloud.read(rows).points
    low = points.min(0) if len(points) else np.zeros(3)
    return Extent(len(points), points[-rows.start % step :: step], low)


@contextmanager
def sorted_into_buckets(
    whole: CloudFile, size: int, extent: Extent, side: float | None, folder: Path
) -> Iterator[tuple[Buckets, list[range]]]:
    """Yield a copy of a file's points in buckets of about ``size`` points.

    Args:
        whole: the file.
        size: rows to read at a time.
        extent: from ``extent_of``.
        side: of cubes that no border may cut, or None.
        folder: for the copy, 32 bytes per point, which is deleted at the end.
    """
    folder.mkdir(parents=True, exist_ok=True)
    share = extent.number / max(len(extent.sample), 1)
    number_of = _borders(extent.sample, max(size / share, 1.0), side, extent.low)
    with TemporaryDirectory(prefix=".tiles-", dir=folder) as name:
        counts: dict[int, int] = {}
        for rows in whole.row_ranges(size):
            table = whole.read_all(rows)
            at = np.arange(rows.start, rows.stop)
            finite = np.isfinite(table.points).all(1)
            _append(Path(name), counts, table.points[finite], at[finite], number_of)
        order = sorted(counts)
        for place, bucket in enumerate(order):
            (Path(name) / f"bucket-{bucket}").rename(Path(name) / f"{place}.bin")
        ends = np.cumsum([0, *(counts[bucket] for bucket in order)]).tolist()
        parts = [range(a, b) for a, b in itertools.pairwise(ends)]
        cloud = Buckets(path=Path(name), number=ends[-1], parts=tuple(parts))
        yield cloud, parts


def _append(
    folder: Path,
    counts: dict[int, int],
    points: Points,
    rows: NDArray[np.int64],
    number_of: Callable[[Points], NDArray[np.int64]],
) -> None:
    """Append points and their rows to the files of their buckets."""
    bucket = number_of(points)
    order = bucket.argsort(kind="stable")
    stored = np.empty(len(order), STORED)
    for column, axis in enumerate("xyz"):
        stored[axis] = points[order, column]
    stored[ROW] = rows[order]
    numbers, first = np.unique(bucket[order], return_index=True)
    for number, part in zip(numbers.tolist(), np.split(stored, first[1:]), strict=True):
        with (folder / f"bucket-{number}").open("ab") as file:
            part.tofile(file)
        counts[number] = counts.get(number, 0) + len(part)


def _borders(
    sample: Points, size: float, side: float | None, low: Points
) -> Callable[[Points], NDArray[np.int64]]:
    """Return a function from points ``(n, 3)`` to the numbers of their buckets ``(n,)``.

    The borders are those of a kd-tree of the sample whose leaves have up to ``size`` points.
    """
    if len(sample) <= size:
        return lambda points: np.zeros(len(points), np.int64)
    axis = int((sample.max(0) - sample.min(0)).argmax())
    border = float(np.median(sample[:, axis]))
    if side is not None:
        border = float(low[axis] + side * np.round((border - low[axis]) / side))
    left = sample[:, axis] < border
    if not left.any() or left.all():
        return lambda points: np.zeros(len(points), np.int64)
    below = _borders(sample[left], size, side, low)
    above = _borders(sample[~left], size, side, low)

    def number_of(points: Points) -> NDArray[np.int64]:
        is_left = points[:, axis] < border
        numbers = np.empty(len(points), np.int64)
        numbers[is_left] = below(points[is_left]) * 2
        numbers[~is_left] = above(points[~is_left]) * 2 + 1
        return numbers

    return number_of


def take(whole: CloudFile, size: int, rows: NDArray[np.int64], engine: Engine) -> Table:
    """Return rows of a file with their attributes.

    Args:
        whole: the file.
        size: rows to read at a time.
        rows: ascending.
        engine: processes the ranges.
    """
    cloud, row_ranges = replace(whole, header=None), whole.row_ranges(size)
    tables: Iterable[Table] = engine("attributes", _take, cloud, row_ranges, rows)
    parts = [table for table in tables if len(table.points)]
    columns: dict[str, Any] = {
        name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns
    }
    return Table(np.concatenate([part.points for part in parts]), columns, whole.header)


def _take(cloud: CloudFile, rows: range, wanted: NDArray[np.int64]) -> Table:
    first, last = np.searchsorted(wanted, [rows.start, rows.stop])
    return cloud.read_all(rows).take(wanted[first:last] - rows.start)
