"""One file that need not fit in memory: several passes over row_ranges of it.

What a pass wants of a stretch does not depend on the others, so an engine may have several
processes or machines do them; the results are put together in the order of the file, so that the
outcome does not depend on who did what.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.downsample.formats.chunks import CloudFile, stored
from mops_lightning.downsample.formats.table import Table, check_enough, radius_of, reach, total
from mops_lightning.errors import UserError
from mops_lightning.ops.attention import Partial
from mops_lightning.ops.nearest import nearest
from mops_lightning.samplers.fused import FusedMOPSNet
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.streaming import global_part, sum_part

Engine = Callable[..., Iterable[Any]]
"""``engine(title, function, cloud, row_ranges, *common)`` gives ``function(cloud, rows, *common)``
for the rows of every stretch, in order."""


class Unit(NamedTuple):
    """How a cloud is put into the unit sphere: its centre ``(3,)`` and largest distance from it."""

    centre: NDArray[np.float64]
    radius: float

    def points(self, table: Table) -> Tensor:
        """Return the normalised points ``(n, 3)``."""
        return torch.from_numpy(((table.points - self.centre) / self.radius).astype(np.float32))


class Nearest(NamedTuple):
    """The nearest points so far: their squared distances ``(m,)`` and their rows of the file."""

    distance: NDArray[np.float32]
    table: Table

    def merge(self, other: "Nearest") -> "Nearest":
        """Keep the nearer ones; where they are equally near, those of the earlier stretch."""
        nearer = other.distance < self.distance
        columns = {
            name: np.where(nearer, other.table.columns[name], column)
            for name, column in self.table.columns.items()
        }
        points = np.where(nearer[:, None], other.table.points, self.table.points)
        return Nearest(np.minimum(self.distance, other.distance), Table(points, columns))


def in_turn(
    title: str,
    function: Callable[..., Any],
    cloud: CloudFile,
    row_ranges: list[range],
    *common: Any,
) -> Iterable[Any]:
    """Do one stretch after the other here: the plainest engine."""
    return (function(cloud, rows, *common) for rows in row_ranges)


def by_chunks(
    source: Path,
    sampler: Any,
    m: int,
    size: int,
    readout: str,
    keep_attributes: bool,
    engine: Engine = in_turn,
) -> tuple[Table, int, int]:
    """Return what a trained MOPS-Net keeps of a file, how many points it has, and how many more.

    What more there are is left out for not being finite.

    Args:
        source: of a format of ``chunks.FORMATS``.
        sampler: trained.
        m: how many points.
        size: of the row_ranges; with m it bounds the memory.
        readout: generated or matched.
        keep_attributes: keep the columns of matched points.
        engine: does the work.

    Raises:
        UserError: the file is broken or too small, or the sampler cannot work by chunks.
    """
    if not isinstance(sampler, MOPSNet):
        raise UserError(f"--chunk works with MOPS-Net and FMOPS-Net, not {type(sampler).__name__}.")
    sampler._check_m(m)
    whole = stored(source)
    cloud, row_ranges = replace(whole, head=None), whole.row_ranges(size)

    def over(title: str, function: Callable[..., Any], *common: Any) -> Iterable[Any]:
        results = engine(title, function, cloud, row_ranges, *common)
        return (result for result in results if result is not None)

    number, summed = 0, np.zeros(3)
    for count, part in over("centre", _count_and_sum):
        number += count
        summed += part
    check_enough(source, number, m)
    centre = summed / number
    unit = Unit(centre, radius_of(max(over("radius", _reach, centre)), source))
    net = sampler.fused()
    global_ = reduce(torch.maximum, over("global feature", _global, unit, net))
    sums: Partial = reduce(Partial.merge, over("sampling", _sum, unit, net, global_, m))
    generated = sums.result()
    if readout == "generated":
        return (
            Table(generated.double().numpy() * unit.radius + centre),
            number,
            whole.number - number,
        )
    found: Nearest = reduce(Nearest.merge, over("matching", _nearest, unit, generated))
    kept = replace(found.table, head=whole.head)
    return (kept if keep_attributes else kept.bare()), number, whole.number - number


def _count_and_sum(cloud: CloudFile, rows: range) -> tuple[int, NDArray[np.float64]]:
    table = cloud.read(rows)
    return len(table.points), total(table.points)


def _reach(cloud: CloudFile, rows: range, centre: NDArray[np.float64]) -> float:
    return reach(cloud.read(rows).points, centre)


def _global(cloud: CloudFile, rows: range, unit: Unit, net: FusedMOPSNet) -> Tensor | None:
    points = unit.points(cloud.read(rows))
    return global_part(net, points) if len(points) else None


def _sum(
    cloud: CloudFile, rows: range, unit: Unit, net: FusedMOPSNet, global_: Tensor, m: int
) -> Partial | None:
    points = unit.points(cloud.read(rows))
    return sum_part(net, points, global_, m) if len(points) else None


def _nearest(cloud: CloudFile, rows: range, unit: Unit, generated: Tensor) -> Nearest | None:
    table = cloud.read(rows)
    if not len(table.points):
        return None
    distance, row = nearest(generated[None], unit.points(table)[None])
    return Nearest(distance[0].numpy(), table.take(row[0].numpy()))
