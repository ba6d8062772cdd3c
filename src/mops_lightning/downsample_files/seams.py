"""Points of neighbouring tiles that are too near to each other."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

NEIGHBOURS = 8
"""Nearest kept points that are looked at."""

CLOSE = 0.5
"""Points of two tiles are too near below this share of the local spacing."""

Places = NDArray[np.int64]


class Seams(NamedTuple):
    """How many pairs of points of two tiles are too near to each other."""

    before: int
    after: int


class Chosen(NamedTuple):
    """Points kept of some tiles.

    Attributes:
        place: ``(k,)`` position of each point in the order of the tiles.
        row: ``(k,)`` its row in the file.
        tile: ``(k,)`` its tile, as the place of the tile's first point.
        points: ``(k, 3)`` in the file's own unit.
    """

    place: Places
    row: Places
    tile: Places
    points: NDArray[np.float64]

    def take(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> "Chosen":
        """Return some of the points."""
        return Chosen(self.place[which], self.row[which], self.tile[which], self.points[which])

    @staticmethod
    def joined(parts: "list[Chosen]") -> "Chosen":
        """Return the points of all parts in the order of their places."""
        whole = Chosen(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
        return whole.take(np.argsort(whole.place, kind="stable"))


def close_pairs(chosen: Chosen) -> NDArray[np.int64]:
    """Find pairs of points of two tiles nearer than half the local spacing.

    The local spacing at a point is the median, over its nearest kept points, of the distance to
    the nearest kept point of the same tile.

    Returns:
        ``(pairs, 2)`` positions in ``chosen``, the lower one first; nearest pairs first.
    """
    number = len(chosen.place)
    if number < 2:
        return np.empty((0, 2), np.int64)
    k = min(NEIGHBOURS + 1, number)
    found: Any = cKDTree(chosen.points).query(chosen.points, k=k)
    distance, other = found
    itself = np.arange(number)[:, None]
    same = chosen.tile[other] == chosen.tile[:, None]
    within = np.where(same & (other != itself), distance, np.inf).min(1)
    spacing = _finite_median(within[other])
    allowed = CLOSE * np.minimum(spacing[:, None], spacing[other])
    near = ~same & (distance < allowed)
    left, column = near.nonzero()
    pairs = np.stack([left, other[near]], 1)
    pairs.sort(1)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], distance[left, column]))
    unique, first = np.unique(pairs[order], axis=0, return_index=True)
    result: NDArray[np.int64] = unique[np.argsort(first)]
    return result


def _finite_median(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lower median of the finite values of every row; 0 if a row has none."""
    ascending = np.sort(values, 1)
    finite = np.isfinite(ascending).sum(1)
    middle = np.take_along_axis(ascending, np.maximum(finite - 1, 0)[:, None] // 2, 1)[:, 0]
    return np.where(finite > 0, middle, 0.0)


def to_drop(pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one point of every pair, unless it has lost its partner already."""
    dropped: set[int] = set()
    for kept, later in pairs.tolist():
        if kept not in dropped and later not in dropped:
            dropped.add(later)
    return np.array(sorted(dropped), np.int64)


def farthest_rows(
    points: NDArray[np.float64], number: int, kept: NDArray[np.int64], around: Any
) -> NDArray[np.int64]:
    """Choose points of a tile one by one, each the farthest from all that are kept.

    Args:
        points: ``(n, 3)`` of the tile.
        number: how many to choose; at most n less the kept ones.
        kept: rows of the tile that are kept.
        around: KD-tree of the kept points of this and other tiles.

    Returns:
        ``(number,)`` rows of the tile, none of them in ``kept``.
    """
    distance = around.query(points)[0]
    distance[kept] = -1
    chosen = []
    for _ in range(number):
        row = int(distance.argmax())
        chosen.append(row)
        distance = np.minimum(distance, np.linalg.norm(points - points[row], axis=1))
        distance[row] = -1
    return np.array(chosen, np.int64)
