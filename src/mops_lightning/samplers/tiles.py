"""Downsampling large scenes by tiles: cut, sample every tile as in training, thin the seams."""

from collections import defaultdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.points import UnitSphere
from mops_lightning.samplers.base import Sampler

Points = NDArray[np.float64]
Rows = NDArray[np.int64]

BATCH = 32768
"""Points of the tiles that are sampled together."""

EXTRA = 1.25
"""Ratio of sampled points to points to keep; the final thinning removes the rest."""

NEIGHBOURS = 8
"""Nearest sampled points that the thinning compares a point with."""


def sample_by_tiles(
    points: Points, size: int, m: int, sampler: Sampler, channels: Tensor | None = None
) -> Rows:
    """Sample every tile of a cloud, then thin the points where tiles meet.

    Points of neighbouring tiles may be nearly equal. Therefore a quarter more points are sampled,
    and one of the nearest two is removed until m remain. Random points are near to each other
    everywhere, not at the seams only, and are not thinned.

    Args:
        points: ``(N, 3)``, N ≥ m.
        size: most points of a tile.
        m: number of points to keep of all tiles together.
        sampler: a flexible sampler.
        channels: ``(N, C)`` of the points, scaled as for training; None: there are none.

    Returns:
        ``(m,)`` different rows, ascending.

    Raises:
        UserError: the tiles keep more points than the sampler can return.
    """
    tiles = balanced_tiles(points, size)
    sizes = [len(tile) for tile in tiles]
    thinned = len(tiles) > 1 and sampler.spreads
    sampled = min(int(EXTRA * m), len(points)) if thinned else m
    numbers = np.minimum(shares(sampled, sizes), sampler.m).tolist()
    if sum(numbers) < m:
        raise UserError(
            f"--m: {len(tiles)} tiles of up to {max(sizes)} points would keep {m} points, but the "
            f"sampler was trained for up to {sampler.m} points of each. Use smaller tiles, or keep "
            "fewer points."
        )
    same: dict[tuple[int, int], list[int]] = defaultdict(list)
    for place, pair in enumerate(zip(sizes, numbers, strict=True)):
        same[pair].append(place)
    selected: list[Rows] = [np.empty(0, np.int64)] * len(tiles)
    for (n, number), places in same.items():
        step = max(BATCH // n, 1)
        for first in range(0, len(places) if number else 0, step):
            batch = places[first : first + step]
            clouds = [points[tiles[place]] for place in batch]
            stacked = torch.stack([_as_input(sampler, one) for one in clouds])
            if channels is not None:
                of_tiles = torch.stack([channels[torch.from_numpy(tiles[p])] for p in batch])
                stacked = torch.cat([stacked, of_tiles], 2)
            rows = sample_tiles(sampler, stacked, number)
            for place, chosen in zip(batch, rows, strict=True):
                selected[place] = tiles[place][chosen]
    kept = np.concatenate(selected)
    return np.sort(kept[thin(points[kept], m)])


def _as_input(sampler: Sampler, points: Points) -> Tensor:
    """Return a tile ``(n, 3)`` as the sampler takes it."""
    if sampler.any_unit:
        return torch.from_numpy(points)
    return UnitSphere.around(points).normalise(points)


def balanced_tiles(points: Points, size: int) -> list[Rows]:
    """Cut a cloud by a balanced kd-tree, across the longest side of every part.

    Args:
        points: ``(n, 3)``, n ≥ 1.
        size: most points of a tile.

    Returns:
        The rows of every tile, ascending. The numbers of rows differ by one at most.
    """
    tiles: list[Rows] = []
    planes = np.ascontiguousarray(points.T)  # extremes are found ten times as fast along memory
    parts = [(np.arange(len(points)), -(-len(points) // size))]
    while parts:
        rows, number = parts.pop()
        if number == 1:
            tiles.append(np.sort(rows))
            continue
        inside = planes.take(rows, 1)
        axis = int((inside.max(1) - inside.min(1)).argmax())
        first = number // 2
        at = len(rows) * first // number
        order = inside[axis].argpartition(at)
        parts += [(rows[order[at:]], number - first), (rows[order[:at]], first)]
    return tiles


def shares(m: int, sizes: list[int]) -> Rows:
    """Share m points among tiles in proportion to their sizes.

    Returns:
        A number for every tile, at most its size; their sum is m.
    """
    ends = np.cumsum([0, *sizes], dtype=np.int64)
    return np.diff(m * ends // ends[-1])


def sample_tiles(sampler: Sampler, tiles: Tensor, m: int) -> Rows:
    """Return m different rows ``(B, m)`` of every tile ``(B, n, 3)``."""
    if m == tiles.shape[1]:
        return np.broadcast_to(np.arange(m), (len(tiles), m))
    rows = sampler.select("completed", tiles, m)[1]
    assert rows is not None
    return rows.numpy()


def thin(points: Points, m: int) -> Rows:
    """Remove one of the nearest two points until m remain.

    Args:
        points: ``(k, 3)``, k ≥ m.
        m: number of points to keep.

    Returns:
        ``(m,)`` rows, ascending.
    """
    excess = len(points) - m
    if not excess:
        return np.arange(m)
    nearest: Any = cKDTree(points).query(points, k=min(NEIGHBOURS + 1, len(points)))
    distance, other = nearest
    rows, column = (other != np.arange(len(points))[:, None]).nonzero()
    nearest_first = distance[rows, column].argsort(kind="stable")
    pairs = np.stack([rows, other[rows, column]], 1)[nearest_first]
    remains = np.ones(len(points), bool)
    for row, neighbour in pairs.tolist():
        if not excess:
            break
        if remains[row] and remains[neighbour]:
            remains[max(row, neighbour)] = False
            excess -= 1
    kept = np.flatnonzero(remains)
    # Too many remain only where many points are equal.
    return np.sort(kept[distance[kept, 1].argsort(kind="stable")[excess:]])
