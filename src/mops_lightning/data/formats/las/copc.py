"""The octree of a COPC file: https://copc.io, version 1.0. Its cells are chunks of LAZ."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil, log2
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.las.chunks import Bytes, Chunk, decompress
from mops_lightning.data.formats.las.header import Header

GAP = 2**16
"""Bytes that are read with their neighbours rather than left out."""

INFO = struct.Struct("<5d2Q2d88x")
"""Centre, half of the side, spacing, place and size of the root's page, range of GPS times."""

ENTRY = struct.Struct("<4iQ2i")
"""Level, x, y and z of a cell; place, size and number of its points, or of a page of entries."""

HIERARCHY = 1000
"""Number of the record after the points that holds the pages."""

PAGE = -1
"""Number of points of an entry that stands for a page."""


class Key(NamedTuple):
    """A cell of an octree."""

    level: int
    x: int
    y: int
    z: int


@dataclass(frozen=True)
class Octree:
    """The octree of a file.

    Attributes:
        low: lowest corner of its cube.
        side: of the cube.
        spacing: distance of the points in the root; it is halved at each level.
        page: place and size of the first page.
    """

    low: tuple[float, ...]
    side: float
    spacing: float
    page: tuple[int, int]

    def overlaps(self, key: Key, area: Area) -> bool:
        """Return whether a cell is in an area."""
        size = self.side / 2**key.level
        corner = np.array(self.low) + np.array(key[1:]) * size
        starts_before_end = corner <= area.high
        ends_after_start = corner + size >= area.low
        overlaps = starts_before_end & ends_after_start
        return bool(overlaps.all())

    def levels(self, area: Area) -> float:
        """Return the deepest level of an area."""
        if area.resolution is not None:
            halvings = log2(self.spacing) - log2(area.resolution)
            return max(0, ceil(halvings))
        if area.level is None:
            return np.inf
        return area.level


def octree_of(header: Header) -> Octree:
    """Return the octree that a COPC file's header describes."""
    assert header.copc is not None
    x, y, z, half, spacing, place, size, *_ = INFO.unpack_from(header.copc.data)
    low = (x - half, y - half, z - half)
    return Octree(low, side=2 * half, spacing=spacing, page=(place, size))


def cells(path: Path, header: Header, area: Area) -> list[Chunk]:
    """Return the cells that overlap an area and have points, in the order of the file."""
    octree = octree_of(header)
    deepest = octree.levels(area)
    found = []
    with path.open("rb") as file:
        size = path.stat().st_size
        for key, chunk in _entries(file, size, octree, area, deepest):
            if key.level <= deepest and octree.overlaps(key, area):
                found.append(chunk)
    return sorted(found)


def _entries(
    file: Any, size: int, octree: Octree, area: Area, deepest: float
) -> Iterator[tuple[Key, Chunk]]:
    """Yield the entries with points of all pages with cells of an area."""
    pages = [octree.page]
    seen = {octree.page[0]}
    while pages:
        place, length = pages.pop()
        if length < ENTRY.size or place + length > size:
            raise ValueError("it ends before its octree")
        file.seek(place)
        whole_entries = length // ENTRY.size
        data = file.read(whole_entries * ENTRY.size)
        for *numbers, start, bytes_, number in ENTRY.iter_unpack(data):
            key = Key(*numbers)
            if number == PAGE:
                is_new = start not in seen
                if is_new and key.level <= deepest and octree.overlaps(key, area):
                    pages.append((start, bytes_))
                    seen.add(start)
            elif number:
                if number < 0 or bytes_ <= 0 or start + bytes_ > size:
                    raise ValueError(f"a cell of its octree has {number} points in {bytes_} bytes")
                yield key, Chunk(start, bytes_, number)


def read_cells(area: Area, path: Path, header: Header, rows: range) -> Bytes:
    """Return the bytes of a range of the points of the cells that overlap an area."""
    found = cells(path, header, area)
    first = 0
    while found and first + found[0].number <= rows.start:
        first += found.pop(0).number
    with path.open("rb") as file:
        wanted = range(rows.start - first, rows.stop - first)
        return decompress(file, header, found, wanted)


def ranges_of_bytes(path: Path, header: Header, area: Area) -> list[tuple[int, int]]:
    """Return where the cells that overlap an area are in a file: starts and ends.

    Cells with little between them are joined: an answer of a server takes as long as ``GAP`` bytes.
    """
    joined: list[tuple[int, int]] = []
    for cell in cells(path, header, area):
        start = cell.start
        stop = cell.start + cell.size
        if joined:
            last_start, last_stop = joined[-1]
            if start - last_stop < GAP:
                joined.pop()
                start = last_start
        joined.append((start, stop))
    return joined
