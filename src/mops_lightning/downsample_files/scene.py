"""Downsampling one scene by tiles, in memory or, with ``chunk``, on disk."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.errors import check_size
from mops_lightning.data.formats.registry import open_cloud_file, read
from mops_lightning.data.formats.table import Table
from mops_lightning.downsample_files.buckets import extent_of, sorted_into_buckets, take
from mops_lightning.downsample_files.cut import Tiling
from mops_lightning.downsample_files.large import Engine, Kept, in_turn
from mops_lightning.downsample_files.seams import Chosen, Seams
from mops_lightning.downsample_files.settings import Settings
from mops_lightning.downsample_files.tiled import ROUNDS, by_tiles, in_memory
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.random import RandomSampler

SURFACE = 10_000
"""Least number of points that are sampled from a mesh."""


def sample_scene(
    source: Path, target: Path, sampler: Sampler, settings: Settings, engine: Engine
) -> Kept:
    """Sample a file by tiles.

    Args:
        source: the file.
        target: the output; with ``chunk`` its folder holds a copy of the coordinates meanwhile.
        sampler: a flexible sampler.
        settings: how.
        engine: processes the parts of the file.

    Raises:
        UserError: the file is broken or too small, or a tile would keep too many points.
    """
    if settings.chunk is None:
        table = read(source, settings.surface or max(SURFACE, 8 * (settings.m or 0)), settings.seed)
        finite = table.finite()
        number = len(finite.points)
        chosen, seams = sample_table(source, finite, sampler, settings, engine)
        kept = finite.take(chosen.row)
        kept = kept if settings.keep_attributes else kept.without_attributes()
        return Kept(kept, number, len(table.points) - number, seams)
    whole, size = open_cloud_file(source), settings.chunk
    extent = extent_of(whole, size, engine)
    tiling = _tiling(source, settings, extent.number, extent.low)
    buckets = sorted_into_buckets(whole, size, extent, settings.tile_size, target.parent)
    with buckets as (cloud, parts):
        chosen, seams = by_tiles(cloud, parts, tiling, sampler, engine, _rounds(sampler))
    if settings.keep_attributes:
        kept = take(whole, size, chosen.row, engine)
    else:
        kept = Table(chosen.points, {}, whole.header)
    return Kept(kept, extent.number, whole.number - extent.number, seams)


def sample_table(
    source: Path, table: Table, sampler: Sampler, settings: Settings, engine: Engine = in_turn
) -> tuple[Chosen, Seams]:
    """Sample a cloud in memory by tiles; see ``sample_scene``."""
    tiling = _tiling(source, settings, len(table.points), table.points.min(0, initial=np.inf))
    cloud, parts = in_memory(table.points, source)
    return by_tiles(cloud, parts, tiling, sampler, engine, _rounds(sampler))


def _rounds(sampler: Sampler) -> int:
    # Random points are near to each other everywhere, not at the seams only.
    return 0 if isinstance(sampler, RandomSampler) else ROUNDS


def _tiling(source: Path, settings: Settings, number: int, low: NDArray[np.float64]) -> Tiling:
    """Return how a cloud of a known size is cut."""
    m = settings.m or max(round((settings.ratio or 0.0) * number), 1)
    check_size(source, number, m)
    return Tiling(number, m, settings.tile, settings.tile_size, low)
