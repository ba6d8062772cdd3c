"""Files that need not fit in memory: several passes over ranges of their rows.

The ranges of a pass are independent, so an engine may distribute them over processes or machines.
Results are merged in the order of the file, so they do not depend on the distribution.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial, reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.channels import PointChannels, coordinates
from mops_lightning.data.formats.cloud_file import PART, CloudFile
from mops_lightning.data.formats.guard import check_coordinates, check_size
from mops_lightning.data.formats.registry import open_cloud_file
from mops_lightning.data.formats.table import Column, Table, join_tables
from mops_lightning.errors import UserError
from mops_lightning.files.engine import Engine
from mops_lightning.files.features import channels_for, generated_columns, with_channels
from mops_lightning.files.options import Options
from mops_lightning.ops.attention import Partial
from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.points import UnitSphere, largest_distance
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.strata import count_classes


class Nearest(NamedTuple):
    """The nearest points so far: their squared distances ``(m,)`` and their table of m rows."""

    distance: NDArray[np.float32]
    table: Table

    def merge(self, other: "Nearest") -> "Nearest":
        """Keep the nearer points; in case of ties, the points of the earlier range."""
        is_nearer = other.distance < self.distance
        number = len(is_nearer)
        rows = np.arange(number)
        rows[is_nearer] += number  # the other table's rows come after this one's
        both = join_tables([self.table, other.table])
        distance = np.minimum(self.distance, other.distance)
        return Nearest(distance, both.take(rows))


class Outcome(NamedTuple):
    """Numbers of points of a downsampled file.

    Attributes:
        kept: number of points that were kept.
        number: how many points with finite coordinates the cloud has.
        dropped: how many it has without.
        drawn: how many were drawn at random, among which the kept ones were chosen; None: all.
    """

    kept: int
    number: int
    dropped: int
    drawn: int | None = None


def sample_by_chunks(
    source: Path, sampler: Sampler, options: Options, engine: Engine
) -> tuple[Table, Outcome]:
    """Sample a file by a trained MOPS-Net without reading it as a whole.

    Args:
        source: of a format in ``registry.CHUNKED``.
        sampler: trained.
        options: ``chunk``, with m, bounds the memory.
        engine: processes the chunks.

    Raises:
        UserError: the file is broken or too small, or the sampler cannot work in chunks.
    """
    assert options.chunk is not None
    _check_streams(sampler, options)
    file = open_cloud_file(source, options.area, options.columns)
    cloud = replace(file, header=None)
    row_ranges = file.row_ranges(options.chunk)

    def over(title: str, function: Callable[..., Any], *common: Any) -> Iterable[Any]:
        work = partial(function, cloud, *common)
        results = engine.map(title, work, row_ranges)
        return (result for result in results if result is not None)

    number = 0
    summed = np.zeros(3)
    for count, part in over("centre", _count_and_sum):
        number += count
        summed += part
    m = options.number(sampler.m, number)
    sampler.check_m(m)
    check_size(source, number, m, options.area)
    centre = summed / number
    radius = max(over("radius", _radius, centre)) or 1.0
    sphere = UnitSphere(centre, radius)
    seen = Seen(sphere, sampler.point_channels)

    def over_seen(title: str, function: Callable[[Tensor], Any]) -> Iterable[Any]:
        return over(title, _of_seen, seen, function)

    if sampler.streams:
        generated = _generate_by_parts(sampler, m, over_seen)
    else:
        generated = _generate_at_once(sampler, m, number, over_seen)
    places = coordinates(generated)
    dropped = 0
    if options.area is None:
        dropped = file.number - number
    outcome = Outcome(m, number, dropped)
    if options.readout == "generated":
        columns = _generated_columns(cloud, row_ranges[0], sampler, generated, options)
        return Table(sphere.restore(places), columns, file.header), outcome
    parts = over("matching", _nearest, sphere, places)
    matched: Nearest = reduce(Nearest.merge, parts)
    kept = replace(matched.table, header=file.header)
    if options.coordinates_only:
        kept = kept.without_attributes()
    return kept, outcome


def _generated_columns(
    cloud: CloudFile,
    rows: range,
    sampler: Sampler,
    generated: Tensor,
    options: Options,
) -> Mapping[str, Column]:
    """Return the channels of generated points, named and typed as in some rows of the file."""
    if options.coordinates_only or not sampler.point_channels:
        return {}
    channels = generated[:, 3:]
    return generated_columns(cloud.read(rows), sampler.point_channels, channels)


OverSeen = Callable[[str, Callable[[Tensor], Any]], Iterable[Any]]
"""Applies a function to the points of every chunk, as the sampler sees them, under a title."""


def _generate_by_parts(sampler: Sampler, m: int, over_seen: OverSeen) -> Tensor:
    """Return the generated points ``(m, 3 + C)``, of which every chunk gives its part."""
    net = sampler.fused()
    global_ = reduce(torch.maximum, over_seen("global feature", net.global_part))
    sum_part = partial(net.sum_part, global_=global_, m=m)
    sums: Partial = reduce(Partial.merge, over_seen("sampling", sum_part))
    return sampler.point_channels.renormalised(sums.result())


@torch.no_grad()
def _generate_at_once(sampler: Sampler, m: int, number: int, over_seen: OverSeen) -> Tensor:
    """Return the generated points ``(m, 3 + C)``; what the sampler sees of all points is kept."""
    width = 3 + len(sampler.point_channels)
    weight = next(sampler.parameters())
    points = weight.new_empty(number, width)
    first = 0
    for part in over_seen("reading", _as_seen):
        points[first : first + len(part)] = part
        first += len(part)
    return sampler(points[None], m).points[0]


def _as_seen(points: Tensor) -> Tensor:
    return points


def _check_streams(sampler: Sampler, options: Options) -> None:
    if sampler.streams or sampler.is_thinned:
        return
    raise UserError(
        f"--chunk: the {options.readout} points of {options.weights} need all points of a cloud at "
        "once. Leave --chunk out, or use --readout completed, which samples --chunk random points. "
        "MOPS-Net and FMOPS-Net take chunks, with anchors=fps if they have candidates."
    )


def count_by_class(source: Path, options: Options, engine: Engine) -> dict[int, int]:
    """Return the number of points of every class of ``options.strata`` in a file."""
    file = open_cloud_file(source, options.area, options.columns)
    function = partial(_count_classes, replace(file, header=None), options)
    total: Counter[int] = Counter()
    for counts in engine.map("counting classes", function, file.row_ranges(PART)):
        total.update(counts)
    return dict(total)


def _count_classes(cloud: CloudFile, options: Options, rows: range) -> dict[int, int]:
    assert options.strata is not None
    table = cloud.read(rows)
    if not len(table.points):
        return {}
    return count_classes(options.strata.classes(table, cloud.path))


def draw(
    source: Path,
    options: Options,
    engine: Engine,
    quotas: Mapping[int, int] | None = None,
) -> tuple[Table, int, int]:
    """Draw random points of a file without reading it as a whole.

    Every point gets a random key, and the points with the lowest keys are drawn. The keys depend on
    the seed and the place in the file, not on ``options.chunk``.

    Args:
        source: of a format in ``registry.CHUNKED``.
        options: ``chunk`` is the number of points to draw.
        engine: reads the ranges.
        quotas: number of points to draw of every class; None: classes do not matter.

    Returns:
        The points, in the order of the file, or all if there are fewer; how many points with finite
        coordinates the file has, and how many without.

    Raises:
        UserError: the file is broken.
    """
    file = open_cloud_file(source, options.area, options.columns)
    function = partial(_draw, replace(file, header=None), options, quotas)
    drawn = Drawn(np.empty(0), join_tables([]), 0)
    for part in engine.map("drawing", function, file.row_ranges(PART)):
        both = drawn.merge(part)
        drawn = both.lowest(source, options, quotas)
    dropped = 0
    if options.area is None:
        dropped = file.number - drawn.number
    return replace(drawn.table, header=file.header), drawn.number, dropped


class Drawn(NamedTuple):
    """The points with the lowest keys so far: their keys, their table, and of how many points."""

    keys: NDArray[np.float64]
    table: Table
    number: int

    def merge(self, other: "Drawn") -> "Drawn":
        """Return the rows of both."""
        keys = np.concatenate([self.keys, other.keys])
        table = join_tables([self.table, other.table])
        return Drawn(keys, table, self.number + other.number)

    def lowest(self, path: Path, options: Options, quotas: Mapping[int, int] | None) -> "Drawn":
        """Keep the points with the lowest keys: ``options.chunk``, or as many of every class."""
        assert options.chunk is not None
        if quotas is None:
            return self.take(_lowest(self.keys, options.chunk))
        assert options.strata is not None
        if not len(self.keys):
            return self
        classes = options.strata.classes(self.table, path)
        by_class = []
        for name, quota in quotas.items():
            members = np.flatnonzero(classes == name)
            chosen = _lowest(self.keys[members], quota)
            by_class.append(members[chosen])
        rows = np.concatenate(by_class)
        return self.take(np.sort(rows))

    def take(self, rows: NDArray[np.int64]) -> "Drawn":
        """Keep some of the points."""
        if len(rows) == len(self.keys):
            return self
        return Drawn(self.keys[rows], self.table.take(rows), self.number)


def _lowest(keys: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Return the rows of the lowest keys, ascending."""
    if len(keys) <= most:
        return np.arange(len(keys))
    lowest = keys.argpartition(most)[:most]
    return np.sort(lowest)


def _draw(
    cloud: CloudFile,
    options: Options,
    quotas: Mapping[int, int] | None,
    rows: range,
) -> Drawn:
    table = cloud.read(rows)
    check_coordinates(cloud.path, table.points)
    if not options.needs_columns:
        table = table.without_attributes()
    rng = np.random.default_rng([options.seed, rows.start])
    keys = rng.random(len(table.points))
    drawn = Drawn(keys, table, len(keys))
    return drawn.lowest(cloud.path, options, quotas)


def _count_and_sum(cloud: CloudFile, rows: range) -> tuple[int, NDArray[np.float64]]:
    points = cloud.read(rows).points
    check_coordinates(cloud.path, points)
    return len(points), points.sum(0)


def _radius(cloud: CloudFile, centre: NDArray[np.float64], rows: range) -> float:
    points = cloud.read(rows).points
    return largest_distance(points, centre)


class Seen(NamedTuple):
    """How a sampler sees the points of a file.

    Attributes:
        sphere: around all points.
        channels: of the sampler; features are columns of the file, because they are not estimated
            from a part of it.
    """

    sphere: UnitSphere
    channels: PointChannels


def _of_seen(cloud: CloudFile, seen: Seen, function: Callable[[Tensor], Any], rows: range) -> Any:
    table = cloud.read(rows)
    if not len(table.points):
        return None
    places = seen.sphere.normalise(table.points)
    channels = channels_for(table, seen.channels, cloud.path, estimates=False)
    return function(with_channels(places, channels))


def _nearest(
    cloud: CloudFile, sphere: UnitSphere, generated: Tensor, rows: range
) -> Nearest | None:
    table = cloud.read(rows)
    if not len(table.points):
        return None
    places = sphere.normalise(table.points)
    distance, row = nearest(generated[None], places[None])
    kept = table.take(row[0].numpy())
    return Nearest(distance[0].numpy(), kept)
