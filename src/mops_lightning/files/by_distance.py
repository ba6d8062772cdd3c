"""Files downsampled to a spacing or to voxels, whole or in ranges of rows, with equal results.

A spacing takes several passes over a file: each draws the points of highest priority to which no
kept point is near, as many as fit in memory, and keeps those that are spaced. Voxels take two: the
first adds up the points of every voxel, the second finds the point nearest to each mean. Kept
points and occupied voxels must fit in memory.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial, reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.cloud_file import CloudFile
from mops_lightning.data.formats.guard import BadCloudError, check_coordinates
from mops_lightning.data.formats.registry import open_cloud_file
from mops_lightning.data.formats.table import Table, join_tables
from mops_lightning.errors import UserError
from mops_lightning.files.chunks import Outcome
from mops_lightning.files.column_means import as_stored, averaged, renormalise, values_of
from mops_lightning.files.column_weights import weights_of
from mops_lightning.files.engine import Engine
from mops_lightning.files.options import Options
from mops_lightning.files.space import check_unit, in_space
from mops_lightning.ops.spacing import keep_spaced, priorities, priority_order, uncovered
from mops_lightning.ops.voxels import Sums, Voxels, occupied, representatives, scales_for
from mops_lightning.ops.voxels import sum_columns as sum_in_voxels
from mops_lightning.ops.weights import CURVATURE

LEAST_CHUNK = 4096
"""Fewest rows of a range: with a few, a spacing would read the file once for every kept point."""


def keep_by_distance(
    source: Path, whole: Table | None, options: Options, engine: Engine
) -> tuple[Table, Outcome]:
    """Downsample a file to ``options.spacing`` or ``options.voxel``.

    Args:
        source: the file.
        whole: its points; None: they are read in ranges of ``options.chunk`` rows.
        options: how.
        engine: processes the ranges.

    Raises:
        UserError: the file is broken, has no points, or has no such columns.
    """
    file = _file(source, whole, options)
    name = "--spacing"
    if options.spacing is None:
        name = "--voxel"
    check_unit(file.header, name, source)
    if options.chunk is not None and options.weight == CURVATURE:
        raise UserError("--weight curvature needs the whole cloud in memory: leave --chunk out.")
    if options.chunk is not None:
        options = replace(options, chunk=max(options.chunk, LEAST_CHUNK))
    # The header of a file is needed only where it is written.
    cloud = replace(file, header=None)
    size = options.chunk or max(file.number, 1)
    ranges = file.row_ranges(size)
    passes = Passes(cloud, ranges, options, engine)
    if options.spacing is not None:
        kept, number = passes.spaced()
    else:
        kept, number = passes.in_voxels()
    if not len(kept.points) and number and options.weight is not None:
        raise BadCloudError(f"--weight {options.weight} of {source}: all weights are 0.")
    if not len(kept.points):
        raise BadCloudError(f"{source} holds no points that could be kept.")
    dropped = 0
    if options.area is None:
        number_of_all = file.number
        if whole is not None:
            number_of_all = len(whole.points)
        dropped = number_of_all - number
    table = replace(kept, header=file.header)
    if options.coordinates_only:
        table = table.without_attributes()
    return table, Outcome(len(table.points), number, dropped)


def _file(source: Path, whole: Table | None, options: Options) -> CloudFile:
    if whole is None:
        return open_cloud_file(source, options.area, options.columns)
    parse = partial(_rows_of, whole)
    return CloudFile(source, len(whole.points), parse, whole.header)


def _rows_of(table: Table, path: Path, rows: range) -> Table:
    places = np.arange(rows.start, rows.stop)
    return replace(table.take(places), header=None)


Weight = NDArray[np.float64] | None


def _weight_of(weight: Weight, rows: NDArray[np.int64]) -> Weight:
    """Return the weights of some points."""
    if weight is None:
        return None
    return weight[rows]


def _joined(first: Weight, second: Weight) -> Weight:
    """Return the weights of two ranges, both of which have some or none."""
    if first is None or second is None:
        return None
    return np.concatenate([first, second])


class Part(NamedTuple):
    """Points of a range of rows that may be kept.

    Attributes:
        table: the points, without those of weight 0, with the columns that are needed.
        rows: ``(n,)`` their rows among the finite points of the range, plus its first row.
        weight: ``(n,)`` their weights, None: all are equal.
        number: how many finite points the range has.
    """

    table: Table
    rows: NDArray[np.int64]
    weight: Weight
    number: int


def _read(cloud: CloudFile, options: Options, rows: range) -> Part:
    table = cloud.read(rows)
    check_coordinates(cloud.path, table.points)
    places = np.arange(len(table.points)) + rows.start
    if options.weight is not None:
        weight = weights_of(table, options.weight, cloud.path)
        heavy = np.flatnonzero(weight)
        return Part(table.take(heavy), places[heavy], weight[heavy], len(places))
    if not options.needs_columns:
        table = table.without_attributes()
    return Part(table, places, None, len(places))


class Candidates(NamedTuple):
    """The points of highest priority so far that no kept point is near to.

    Attributes:
        table: the points.
        rows: ``(n,)`` see ``Part``.
        used: ``(n, C)`` their coordinates in the space of distances.
        weight: ``(n,)`` or None.
        number: of finite points that were read.
        is_cut: whether there are more.
    """

    table: Table
    rows: NDArray[np.int64]
    used: NDArray[np.float64]
    weight: Weight
    number: int
    is_cut: bool = False

    def take(self, rows: NDArray[np.int64], is_cut: bool) -> "Candidates":
        """Return the candidates in some rows."""
        return Candidates(
            table=self.table.take(rows),
            rows=self.rows[rows],
            used=self.used[rows],
            weight=_weight_of(self.weight, rows),
            number=self.number,
            is_cut=is_cut,
        )

    def first(self, most: int | None, seed: int) -> "Candidates":
        """Return the candidates that come first, each place once, in the order of the file."""
        if most is None or len(self.rows) <= most:
            return self
        hashes = priorities(self.used, seed)
        order = priority_order(self.used, hashes, self.weight)
        ordered = self.used[order]
        is_new = np.ones(len(order), bool)
        differs = ordered[1:] != ordered[:-1]
        is_new[1:] = differs.any(axis=1)
        order = order[is_new]
        is_cut = self.is_cut or len(order) > most
        return self.take(np.sort(order[:most]), is_cut)

    def merge(self, other: "Candidates") -> "Candidates":
        """Join the candidates of two ranges, of which the other one comes later."""
        number = self.number + other.number
        is_cut = self.is_cut or other.is_cut
        if not len(self.rows):
            return other._replace(number=number, is_cut=is_cut)
        if not len(other.rows):
            return self._replace(number=number)
        return Candidates(
            table=join_tables([self.table, other.table]),
            rows=np.concatenate([self.rows, other.rows]),
            used=np.concatenate([self.used, other.used]),
            weight=_joined(self.weight, other.weight),
            number=number,
            is_cut=is_cut,
        )


def _candidates(
    cloud: CloudFile,
    options: Options,
    kept: NDArray[np.float64] | None,
    rows: range,
) -> Candidates:
    assert options.spacing is not None
    part = _read(cloud, options, rows)
    used = in_space(part.table, options.space, cloud.path)
    found = Candidates(part.table, part.rows, used, part.weight, part.number)
    if kept is not None:
        rows_left = uncovered(used, kept, options.spacing)
        found = found.take(rows_left, is_cut=False)
    return found.first(options.chunk, options.seed)


class Found(NamedTuple):
    """One point for each of some voxels.

    Attributes:
        table: the points.
        rows: ``(n,)`` see ``Part``.
        voxel: ``(n,)`` the voxel of every point.
        distance: ``(n,)`` squared distance from its mean.
        weight: ``(n,)`` or None.
    """

    table: Table
    rows: NDArray[np.int64]
    voxel: NDArray[np.int64]
    distance: NDArray[np.float64]
    weight: Weight

    def take(self, rows: NDArray[np.int64]) -> "Found":
        """Return some of the points."""
        return Found(
            table=self.table.take(rows),
            rows=self.rows[rows],
            voxel=self.voxel[rows],
            distance=self.distance[rows],
            weight=_weight_of(self.weight, rows),
        )

    def merge(self, other: "Found") -> "Found":
        """Keep the better point of every voxel; see ``representatives``."""
        if not len(self.rows):
            return other
        if not len(other.rows):
            return self
        both = Found(
            table=join_tables([self.table, other.table]),
            rows=np.concatenate([self.rows, other.rows]),
            voxel=np.concatenate([self.voxel, other.voxel]),
            distance=np.concatenate([self.distance, other.distance]),
            weight=_joined(self.weight, other.weight),
        )
        return both._first_of_voxels()

    def _first_of_voxels(self) -> "Found":
        """Return the heaviest point of every voxel, of equals the nearest to its mean."""
        x, y, z = self.table.points.T
        lightness = np.zeros(len(self.rows))
        if self.weight is not None:
            lightness = -self.weight
        # The last key of a lexsort comes first.
        keys = (self.rows, z, y, x, self.distance, lightness, self.voxel)
        order = np.lexsort(keys)
        ordered = self.voxel[order]
        is_first = np.ones(len(order), bool)
        is_first[1:] = ordered[1:] != ordered[:-1]
        return self.take(order[is_first])


def _occupied(cloud: CloudFile, options: Options, rows: range) -> tuple[Voxels, int]:
    assert options.voxel is not None
    part = _read(cloud, options, rows)
    return occupied(part.table.points, options.voxel), part.number


def _found(cloud: CloudFile, options: Options, voxels: Voxels, rows: range) -> Found:
    assert options.voxel is not None
    part = _read(cloud, options, rows)
    best = representatives(part.table.points, options.voxel, voxels, part.weight)
    voxel = np.flatnonzero(best.rows >= 0)
    kept = best.rows[voxel]
    return Found(
        table=part.table.take(kept),
        rows=part.rows[kept],
        voxel=voxel,
        distance=best.distances[voxel],
        weight=_weight_of(part.weight, kept),
    )


def _largest(
    cloud: CloudFile, options: Options, names: list[str], rows: range
) -> NDArray[np.float64]:
    table = _read(cloud, options, rows).table
    values = values_of(table, names)
    values[~np.isfinite(values)] = 0.0
    largest: NDArray[np.float64] = np.abs(values).max(axis=0, initial=0.0)
    return largest


def _column_sums(
    cloud: CloudFile,
    options: Options,
    names: list[str],
    voxels: Voxels,
    scales: NDArray[np.float64],
    rows: range,
) -> Sums:
    assert options.voxel is not None
    table = _read(cloud, options, rows).table
    values = values_of(table, names)
    return sum_in_voxels(table.points, options.voxel, voxels, values, scales)


def _add(left: Sums, right: Sums) -> Sums:
    high = left.high + right.high
    low = left.low + right.low
    return Sums(high, low, wrong=left.wrong + right.wrong)


class Passes(NamedTuple):
    """Passes over the rows of a file, range by range.

    Attributes:
        cloud: the file.
        ranges: of its rows.
        options: how it is downsampled.
        engine: processes the ranges.
    """

    cloud: CloudFile
    ranges: list[range]
    options: Options
    engine: Engine

    def over(self, title: str, function: Any, *common: Any) -> Iterable[Any]:
        """Return the function's result for every range, in order."""
        work = partial(function, self.cloud, self.options, *common)
        return self.engine.map(title, work, self.ranges)

    def spaced(self) -> tuple[Table, int]:
        """Return the points that a spacing keeps, and how many finite points the file has."""
        spacing = self.options.spacing
        assert spacing is not None
        kept: Candidates | None = None
        number = 0
        is_cut = True
        while is_cut:
            used = None
            if kept is not None:
                used = kept.used
            drawn = self._drawn(used)
            if drawn is None:
                break
            is_cut = drawn.is_cut
            number = drawn.number
            rows = keep_spaced(drawn.used, spacing, self.options.seed, drawn.weight)
            new = drawn.take(rows, is_cut)
            if kept is None:
                kept = new
            else:
                kept = kept.merge(new)
        if kept is None:
            return Table(np.empty((0, 3))), 0
        in_order = kept.rows.argsort()
        return kept.table.take(in_order), number

    def _drawn(self, used: NDArray[np.float64] | None) -> Candidates | None:
        """Return the first candidates of all parts that kept points leave; None without parts."""
        drawn: Candidates | None = None
        for part in self.over("spacing", _candidates, used):
            if drawn is None:
                drawn = part
            else:
                drawn = drawn.merge(part)
            drawn = drawn.first(self.options.chunk, self.options.seed)
        return drawn

    def in_voxels(self) -> tuple[Table, int]:
        """Return one point of every voxel, and how many finite points the file has."""
        number = 0
        voxels: Voxels | None = None
        for occupied_in_part, number_in_part in self.over("voxels", _occupied):
            number += number_in_part
            if voxels is None:
                voxels = occupied_in_part
            else:
                voxels = voxels.merge(occupied_in_part)
        if voxels is None or not len(voxels.counts):
            return Table(np.empty((0, 3))), number
        parts = self.over("nearest", _found, voxels)
        found: Found = reduce(Found.merge, parts)
        if self.options.readout == "generated":
            return self._means(voxels, found), number
        in_order = found.rows.argsort()
        return found.table.take(in_order), number

    def _means(self, voxels: Voxels, found: Found) -> Table:
        """Return the means of all voxels; columns of names are those of the nearest points."""
        assert self.options.voxel is not None
        nearest = found.table.take(found.voxel.argsort())
        names = averaged(nearest)
        columns = dict(nearest.columns)
        if names:
            parts = self.over("scale", _largest, names)
            largest: NDArray[np.float64] = reduce(np.maximum, parts)
            scales = scales_for(largest)
            work = self.over("means", _column_sums, names, voxels, scales)
            sums: Sums = reduce(_add, work)
            means = sums.means(voxels.counts, scales)
            for name, values in zip(names, means.T, strict=True):
                columns[name] = as_stored(values, nearest.columns[name])
        renormalise(columns)
        is_alone = voxels.counts == 1
        means_of_voxels = voxels.means(self.options.voxel)
        points = np.where(is_alone[:, None], nearest.points, means_of_voxels)
        form = replace(nearest.form, coordinates=None)
        return replace(nearest, points=points, columns=columns, form=form)
