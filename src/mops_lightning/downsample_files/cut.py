"""Cutting a cloud into tiles, and sharing out the points to keep."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mops_lightning.errors import UserError

Points = NDArray[np.float64]
Rows = NDArray[np.int64]

FINEST = 2**20
"""Most cubes along an axis: three positions fit in an integer of 64 bits."""


class Tiling(NamedTuple):
    """How a cloud is cut, and how many of its points are kept.

    Attributes:
        number: points of the cloud.
        m: points to keep of all tiles together.
        tile: most points of a tile of the balanced kd-tree; None: cubes.
        tile_size: side of the cubes, in the file's own unit.
        origin: a corner of a cube, ``(3,)``.
    """

    number: int
    m: int
    tile: int | None
    tile_size: float | None
    origin: Points

    def cut(self, points: Points) -> list[Rows]:
        """Return the rows of every tile of ``(n, 3)`` points."""
        if self.tile is not None:
            return balanced_tiles(points, self.tile)
        assert self.tile_size is not None
        return cubes(points, self.tile_size, self.origin)

    def shares(self, start: int, sizes: list[int]) -> Rows:
        """Return how many points to keep of consecutive tiles, in proportion to their sizes.

        The shares of all tiles of a cloud sum to ``m`` exactly, in whatever parts they are asked
        for, and none is larger than its tile.

        Args:
            start: number of points in all tiles before these.
            sizes: numbers of points of the tiles.
        """
        ends = start + np.cumsum([0, *sizes], dtype=np.int64)
        return np.diff(self.m * ends // self.number)


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


def cubes(points: Points, side: float, origin: Points) -> list[Rows]:
    """Cut a cloud into cubes.

    Args:
        points: ``(n, 3)``, n ≥ 1.
        side: of a cube.
        origin: a corner of a cube, not above any point.

    Returns:
        The rows of every cube that has points, ascending; the cubes in the order x, y, z.

    Raises:
        UserError: there are too many cubes along an axis.
    """
    position = np.floor((points - origin) / side)
    if not position.max() < FINEST:
        raise UserError(
            f"--tile-size {side:g} cuts the cloud into more than {FINEST:,} cubes along an axis. "
            "Increase it; it is in the file's own unit."
        )
    x, y, z = position.astype(np.int64).T
    key = (x * FINEST + y) * FINEST + z
    order = key.argsort(kind="stable")
    return np.split(order, np.flatnonzero(np.diff(key[order])) + 1)
