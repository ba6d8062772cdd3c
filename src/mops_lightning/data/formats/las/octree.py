"""Sorting points into the cells of an octree, of any number of points.

Every cell keeps an even sample of the points below it: of each cube of a grid in the cell, the
point nearest to the cube's centre. Points beyond ``MEMORY`` wait in temporary files.
"""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.las.copc import Key
from mops_lightning.data.formats.las.layout import Rows

GRID = 128
"""Cubes along the side of a cell; the root's points are this part of its side apart."""

LEAF = 50_000
"""Most points of a cell, unless more have nearly equal coordinates."""

MEMORY = 1_000_000
"""Points that are sorted in memory."""

DEEPEST = 20
"""Level of the smallest cells."""

PART = 250_000
"""Points that are read from a temporary file at a time."""

Emit = Callable[[Key, Rows], None]
"""Takes a cell and its points; cells without points are those above others."""


class Waiting:
    """Points of one cell in a temporary file, which the system deletes when it is closed."""

    def __init__(self, folder: Path, kind: "np.dtype[np.void]") -> None:
        self.file: IO[bytes] = TemporaryFile(dir=folder)  # noqa: SIM115, it outlives this call
        self.kind = kind
        self.number = 0

    def add(self, rows: Rows) -> None:
        """Add points."""
        self.file.write(rows.tobytes())
        self.number += len(rows)

    def parts(self) -> Iterator[Rows]:
        """Yield all points, part by part, and close the file."""
        with self.file:
            self.file.seek(0)
            size = PART * self.kind.itemsize
            while data := self.file.read(size):
                yield np.frombuffer(data, self.kind)


class Builder:
    """Builds an octree from the leaves to the root.

    Attributes:
        low: ``(3,)`` lowest corner of its cube.
        side: of the cube.
        scales: ``(3,)`` of the packed coordinates.
        offsets: ``(3,)`` of the packed coordinates.
        emit: takes the finished cells.
        folder: of temporary files.
    """

    def __init__(
        self,
        low: NDArray[np.float64],
        side: float,
        scales: tuple[float, ...],
        offsets: tuple[float, ...],
        emit: Emit,
        folder: Path,
    ) -> None:
        self.low = low
        self.side = side
        self.scales = scales
        self.offsets = offsets
        self.emit = emit
        self.folder = folder

    def build(self, parts: Iterable[Rows], number: int) -> None:
        """Sort points into cells.

        Args:
            parts: packed points ``(n,)``.
            number: how many points all parts have.
        """
        root = Key(0, 0, 0, 0)
        rows, _ = self._sample(root, parts, number)
        self.emit(root, rows)

    def _sample(self, key: Key, parts: Iterable[Rows], number: int) -> tuple[Rows, bool]:
        """Build what is below a cell; return the cell's points and whether cells are below it."""
        if number <= LEAF or key.level == DEEPEST:
            return np.concatenate(list(parts)), False
        samples = []
        for child, below, count in self._split(key, parts, number):
            sample, has_cells = self._sample(child, below, count)
            samples.append((child, sample, has_cells))
        rows = np.concatenate([sample for _, sample, _ in samples])
        chosen = np.zeros(len(rows), bool)
        chosen[self._thin(key, rows)] = True
        start = 0
        for child, sample, has_cells in samples:
            is_chosen = chosen[start : start + len(sample)]
            left = sample[~is_chosen]
            start += len(sample)
            if len(left) or has_cells:
                self.emit(child, left)
        return rows[chosen], True

    def _split(
        self, key: Key, parts: Iterable[Rows], number: int
    ) -> Iterator[tuple[Key, Iterable[Rows], int]]:
        """Yield the cells below a cell, their points and how many these are."""
        if number <= MEMORY:
            rows = np.concatenate(list(parts))
            octants = self._octants(key, rows)
            for octant in np.unique(octants).tolist():
                below = rows[octants == octant]
                yield _child(key, octant), [below], len(below)
            return
        waiting: dict[int, Waiting] = {}
        for rows in parts:
            octants = self._octants(key, rows)
            for octant in np.unique(octants).tolist():
                if octant not in waiting:
                    waiting[octant] = Waiting(self.folder, rows.dtype)
                waiting[octant].add(rows[octants == octant])
        for octant in sorted(waiting):
            place = waiting[octant]
            yield _child(key, octant), place.parts(), place.number

    def _octants(self, key: Key, rows: Rows) -> NDArray[np.int64]:
        """Return which of the eight cells below a cell every point is in."""
        octants = np.zeros(len(rows), np.int64)
        for place in range(3):
            cells_of_octants = 2 ** (key.level + 1)
            along = self._along(rows, place) / self.side * cells_of_octants
            start = 2 * key[1 + place]
            half = np.clip(np.floor(along) - start, 0, 1)
            octants |= half.astype(np.int64) << place
        return octants

    def _along(self, rows: Rows, place: int) -> NDArray[np.float64]:
        """Return the distances from the low side of the cube."""
        whole = rows["XYZ"[place]]
        coordinates = whole * self.scales[place] + self.offsets[place]
        distances: NDArray[np.float64] = coordinates - self.low[place]
        return distances

    def _thin(self, key: Key, rows: Rows) -> NDArray[np.int64]:
        """Return the rows that are the sample of a cell."""
        size = self.side / 2**key.level
        distances_of_axes = [self._along(rows, place) for place in range(3)]
        along = np.stack(distances_of_axes, 1) / size - key[1:]
        grid = GRID
        while True:
            cells = np.floor(along * grid)
            cubes = np.clip(cells, 0, grid - 1).astype(np.int64)
            x, y, z = cubes.T
            numbers = (x * grid + y) * grid + z
            if grid == 1 or len(np.unique(numbers)) <= LEAF:
                break
            grid //= 2
        from_centre = along * grid - cubes - 0.5
        distances = (from_centre**2).sum(1)
        order = np.lexsort((distances, numbers))
        first = np.ones(len(order), bool)
        ordered = numbers[order]
        first[1:] = ordered[1:] != ordered[:-1]
        return order[first]


def _child(key: Key, octant: int) -> Key:
    """Return a cell below a cell; bits 0 to 2 of ``octant`` say which half in x, y and z."""
    places = []
    for axis in range(3):
        bit = octant >> axis & 1
        places.append(2 * key[1 + axis] + bit)
    x, y, z = places
    return Key(key.level + 1, x, y, z)
