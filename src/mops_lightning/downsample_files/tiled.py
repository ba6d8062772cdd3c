"""Downsampling large scenes by tiles: cut, sample every tile as in training, look after the seams.

What is kept depends on the cloud and the settings only, not on who samples which tile, or when.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from mops_lightning.data.formats.cloud_file import CloudFile
from mops_lightning.data.formats.errors import BadCloudError
from mops_lightning.data.formats.table import Table
from mops_lightning.downsample_files.cut import Tiling
from mops_lightning.downsample_files.large import Engine
from mops_lightning.downsample_files.seams import (
    Chosen,
    Seams,
    close_pairs,
    farthest_rows,
    to_drop,
)
from mops_lightning.errors import UserError
from mops_lightning.ops.readout import complete, match
from mops_lightning.samplers.base import Sampler

BATCH = 32768
"""Points of the tiles that are sampled together."""

ROUNDS = 3
"""Most passes over the seams."""

ROW = "row"
"""The column of a point's row in the user's file."""


@dataclass(frozen=True, kw_only=True)
class InMemory(CloudFile):
    """A cloud in memory, in the form that an engine takes."""

    points: NDArray[np.float64]

    def _parse(self, rows: range) -> Table:
        columns = {ROW: np.arange(rows.start, rows.stop)}
        return Table(self.points[rows.start : rows.stop], columns)


def in_memory(points: NDArray[np.float64], path: Path) -> tuple[CloudFile, list[range]]:
    """Return a cloud in the form that ``by_tiles`` takes.

    Args:
        points: ``(N, 3)``.
        path: the file, for errors.
    """
    cloud = InMemory(path=path, number=len(points), points=points)
    return cloud, cloud.row_ranges(len(points))


def by_tiles(
    cloud: CloudFile,
    parts: list[range],
    tiling: Tiling,
    sampler: Sampler,
    engine: Engine,
    rounds: int = ROUNDS,
) -> tuple[Chosen, Seams]:
    """Sample every tile of a cloud.

    Args:
        cloud: its column ``ROW`` has the rows of the user's file.
        parts: ranges that are cut into tiles on their own, in order and without gaps.
        tiling: how they are cut.
        sampler: a flexible sampler.
        engine: processes the parts.
        rounds: most passes over the seams.

    Returns:
        The kept points, by their row in the user's file, ``tiling.m`` different ones; and the
        number of close pairs at the seams.

    Raises:
        UserError: a tile keeps more points than the sampler can return.
    """

    def over(title: str, function: Callable[..., Any], *common: Any) -> Iterable[Any]:
        return engine(title, function, cloud, parts, tiling, *common)

    chosen = Chosen.joined(list(over("sampling tiles", _sample, sampler)))
    pairs = close_pairs(chosen)
    before = len(pairs)
    for _ in range(rounds):
        if not len(pairs):
            break
        dropped = to_drop(pairs)
        lost = chosen.tile[dropped]
        kept = chosen.take(np.delete(np.arange(len(chosen.place)), dropped))
        refilled = Chosen.joined([kept, *over("seams", _refill, kept, lost)])
        pairs_now = close_pairs(refilled)
        if len(pairs_now) >= len(pairs):
            break
        chosen, pairs = refilled, pairs_now
    return chosen.take(np.argsort(chosen.row)), Seams(before, len(pairs))


def _sample(cloud: CloudFile, rows: range, tiling: Tiling, sampler: Sampler) -> Chosen:
    """Sample the tiles of one part."""
    table = cloud.read(rows)
    tiles = tiling.cut(table.points)
    sizes = [len(tile) for tile in tiles]
    numbers = tiling.shares(rows.start, sizes).tolist()
    starts = rows.start + np.cumsum([0, *sizes[:-1]])
    if max(numbers) > sampler.m:
        n, m = max(zip(sizes, numbers, strict=True), key=lambda pair: pair[1])
        raise UserError(
            f"--m: a tile of {n} points would keep {m}, but the sampler was trained for up to "
            f"{sampler.m}. Use smaller tiles, or keep fewer points."
        )
    same: dict[tuple[int, int], list[int]] = defaultdict(list)
    for i, pair in enumerate(zip(sizes, numbers, strict=True)):
        same[pair].append(i)
    found: list[NDArray[np.int64]] = [np.empty(0, np.int64)] * len(tiles)
    for (n, m), members in same.items():
        if m == 0:
            continue
        step = max(BATCH // n, 1)
        for first in range(0, len(members), step):
            batch = members[first : first + step]
            points = _normalised(np.stack([table.points[tiles[i]] for i in batch]), cloud.path)
            rows_of = _rows(sampler, points, m).numpy()
            for i, chosen in zip(batch, rows_of, strict=True):
                found[i] = tiles[i][chosen]
    return _chosen(table, rows.start, found, starts)


def _chosen(table: Table, start: int, found: list[Any], starts: NDArray[np.int64]) -> Chosen:
    local = np.concatenate(found)
    tile = np.repeat(starts, [len(one) for one in found])
    return Chosen(start + local, table.columns[ROW][local], tile, table.points[local])


def _normalised(points: NDArray[np.float64], path: Path) -> Tensor:
    """Return tiles ``(B, n, 3)`` in the unit sphere, as in training."""
    with np.errstate(over="ignore", invalid="ignore"):
        centred = points - points.mean(1, keepdims=True)
        radius = np.linalg.norm(centred, axis=2).max(1)[:, None, None]
    if not np.isfinite(radius).all():
        raise BadCloudError(f"{path}: its coordinates are too large for float64 distances.")
    return torch.from_numpy((centred / np.where(radius > 0, radius, 1.0)).astype(np.float32))


@torch.no_grad()
def _rows(sampler: Sampler, points: Tensor, m: int) -> Tensor:
    """Return m different rows ``(B, m)`` of every tile ``(B, n, 3)``."""
    if m == points.shape[1]:
        return torch.arange(m).expand(len(points), m)
    output = sampler(points, m)
    if output.indices is not None:
        return output.indices
    return complete(match(output.points, points), points)


def _refill(
    cloud: CloudFile, rows: range, tiling: Tiling, kept: Chosen, lost: NDArray[np.int64]
) -> Chosen:
    """Choose new points for the tiles of one part that lost some.

    Args:
        cloud: see ``by_tiles``.
        rows: the part.
        tiling: how it is cut.
        kept: the kept points of all parts, in the order of their places.
        lost: the tile of every point that was dropped.
    """
    here = lost[(lost >= rows.start) & (lost < rows.stop)]
    if not len(here):
        return kept.take(np.empty(0, np.int64))
    table = cloud.read(rows)
    tiles = tiling.cut(table.points)
    starts = rows.start + np.cumsum([0, *(len(tile) for tile in tiles)])[:-1]
    at, numbers = np.unique(here, return_counts=True)
    lost_from = [tiles[int(np.searchsorted(starts, start))] for start in at.tolist()]
    first, last = np.searchsorted(kept.place, [rows.start, rows.stop])
    of_part = kept.take(np.arange(first, last))
    own = [of_part.place[of_part.tile == start] - rows.start for start in at.tolist()]
    near = kept.points
    if all(map(len, own)):
        near = _near(near, [table.points[tile] for tile in lost_from])
    around = cKDTree(near)
    found = []
    for tile, number, left in zip(lost_from, numbers.tolist(), own, strict=True):
        rows_kept = np.searchsorted(tile, left)
        found.append(tile[farthest_rows(table.points[tile], number, rows_kept, around)])
    return _chosen(table, rows.start, found, at)


def _near(kept: NDArray[np.float64], tiles: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the kept points that can be nearest to a point of a tile; every tile has some."""
    lows = np.stack([tile.min(0) for tile in tiles])
    highs = np.stack([tile.max(0) for tile in tiles])
    # No point is farther from a kept point of its tile than the tile is long.
    reach = float(np.linalg.norm(highs - lows, axis=1).max()) * (1 + 1e-9)
    near = (kept >= lows.min(0) - reach) & (kept <= highs.max(0) + reach)
    return kept[near.all(1)]
