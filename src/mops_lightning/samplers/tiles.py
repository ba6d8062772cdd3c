"""Downsampling large scenes by tiles: cut, sample every tile as in training, thin the seams."""

import math
from collections import defaultdict
from collections.abc import Iterator
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
    points: Points,
    size: int,
    m: int,
    sampler: Sampler,
    channels: Tensor | None = None,
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
    is_thinned = len(tiles) > 1 and sampler.spreads
    sampled = m
    if is_thinned:
        sampled = min(int(EXTRA * m), len(points))
    proportional = shares(sampled, sizes)
    numbers = np.minimum(proportional, sampler.m).tolist()
    if sum(numbers) < m:
        raise UserError(
            f"--m: {len(tiles)} tiles of up to {max(sizes)} points would keep {m} points, but the "
            f"sampler was trained for up to {sampler.m} points of each. Use smaller tiles, or keep "
            "fewer points."
        )
    no_rows: Rows = np.empty(0, np.int64)
    selected = [no_rows] * len(tiles)
    for batch in _batches(sizes, numbers):
        batch_of_tiles = [tiles[number] for number in batch]
        stacked = _stacked(sampler, points, batch_of_tiles, channels)
        rows = sample_tiles(sampler, stacked, numbers[batch[0]])
        for number, rows_in_tile in zip(batch, rows, strict=True):
            selected[number] = tiles[number][rows_in_tile]
    kept = np.concatenate(selected)
    spaced = thin(points[kept], m)
    return np.sort(kept[spaced])


def _batches(sizes: list[int], numbers: list[int]) -> Iterator[list[int]]:
    """Yield tiles that are sampled together: of one size, of which one number is kept.

    Args:
        sizes: points of every tile.
        numbers: points to keep of every tile; tiles that keep none are left out.
    """
    alike: dict[tuple[int, int], list[int]] = defaultdict(list)
    for tile, size in enumerate(sizes):
        number = numbers[tile]
        if number > 0:
            alike[size, number].append(tile)
    for (size, _), tiles in alike.items():
        step = max(BATCH // size, 1)
        for first in range(0, len(tiles), step):
            yield tiles[first : first + step]


def _stacked(
    sampler: Sampler, points: Points, tiles: list[Rows], channels: Tensor | None
) -> Tensor:
    """Return tiles of one size ``(B, n, 3 + C)`` as the sampler takes them."""
    inputs = [_as_input(sampler, points[tile]) for tile in tiles]
    places = torch.stack(inputs)
    if channels is None:
        return places
    of_tiles = [channels[torch.from_numpy(tile)] for tile in tiles]
    return torch.cat([places, torch.stack(of_tiles)], 2)


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
    number_of_tiles = math.ceil(len(points) / size)
    parts = [(np.arange(len(points)), number_of_tiles)]
    while parts:
        rows, number = parts.pop()
        if number == 1:
            tiles.append(np.sort(rows))
            continue
        inside = planes.take(rows, 1)
        extents = inside.max(1) - inside.min(1)
        axis = int(extents.argmax())
        in_lower = number // 2
        at = len(rows) * in_lower // number
        order = inside[axis].argpartition(at)
        lower = (rows[order[:at]], in_lower)
        upper = (rows[order[at:]], number - in_lower)
        parts += [upper, lower]
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
        everything = np.arange(m)
        return np.broadcast_to(everything, (len(tiles), m))
    _, rows = sampler.select("completed", tiles, m)
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
    rows = _with_fewest_copies(points, m)
    while len(rows) > m:
        rows = rows[_remove_near(points[rows], len(rows) - m)]
    return rows


def _with_fewest_copies(points: Points, m: int) -> Rows:
    """Return the first row of equal points and, where these are fewer than m, rows of copies."""
    _, first_rows = np.unique(points, axis=0, return_index=True)
    is_first = np.zeros(len(points), bool)
    is_first[first_rows] = True
    copies = np.flatnonzero(~is_first)
    number_of_copies = max(m - len(first_rows), 0)
    is_first[copies[:number_of_copies]] = True
    return np.flatnonzero(is_first)


def _remove_near(points: Points, excess: int) -> Rows:
    """Remove one of the nearest two of different points, ``excess`` points at most.

    Every point is compared with its nearest ones only. Once all of these are removed, it may stay
    though another one is near.

    Returns:
        The rows that remain, ascending.
    """
    tree = cKDTree(points)
    nearest: Any = tree.query(points, k=min(NEIGHBOURS + 1, len(points)))
    distance, other = nearest
    own = np.arange(len(points))[:, None]
    rows, column = (other != own).nonzero()
    nearest_first = distance[rows, column].argsort(kind="stable")
    all_pairs = np.stack([rows, other[rows, column]], 1)
    pairs = all_pairs[nearest_first]
    remains = np.ones(len(points), bool)
    for row, neighbour in pairs.tolist():
        if not excess:
            break
        if remains[row] and remains[neighbour]:
            remains[max(row, neighbour)] = False
            excess -= 1
    return np.flatnonzero(remains)
