"""Writing small COPC files, which laspy reads only.

Layout: https://copc.io, version 1.0. The cells of the octree are chunks of LAZ of any size.
"""

import struct
from pathlib import Path

import laspy
import lazrs
import numpy as np
from numpy.typing import NDArray

INFO = 1
HIERARCHY = 1000
"""Numbers of COPC's records."""

ENTRY = struct.Struct("<4iQ2i")
"""Level, x, y and z of a cell; place, size and number of its points, -1 for a page of entries."""


def write_copc(
    path: Path,
    points: NDArray[np.float64],
    spacing: float,
    depth: int = 3,
    each: int = 300,
    in_pages: bool = False,
) -> None:
    """Write points ``(n, 3)`` with their rows as ``intensity`` modulo 65,536.

    Args:
        path: the file.
        points: in random order.
        spacing: of the root's points; it is halved at each level.
        depth: deepest level, which takes all points that are left.
        each: points of every other cell.
        in_pages: whether the cells of each octant, but for the root, are in a page of their own.
    """
    low = points.min(0)
    high = points.max(0)
    half = float((high - low).max()) / 2 + 1e-3
    centre = (low + high) / 2
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets = centre
    header.scales = [1e-3] * 3
    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    record.x, record.y, record.z = points.T
    record.intensity = np.arange(len(points)) % 2**16
    header.point_count = len(points)
    header.are_points_compressed = True
    header.mins = low
    header.maxs = high
    laz = lazrs.LazVlr.new_for_compression(6, 0, True)

    def write_header(page: int, size: int) -> None:
        """Write the header; the place of the octree's page is known when all cells are written."""
        info = struct.pack("<5d2Q2d88x", *centre, half, spacing, page, size, 0, 0)
        records = [
            laspy.VLR("copc", INFO, "", info),
            laspy.VLR("laszip encoded", 22204, "", laz.record_data()),
        ]
        header.vlrs = laspy.vlrs.vlrlist.VLRList(records)
        header.number_of_evlrs = int(page > 0)
        header.start_of_first_evlr = max(page - 60, 0)
        stream.seek(0)
        header.write_to(stream)

    with path.open("wb") as stream:
        write_header(0, 0)
        cells = _write_cells(stream, laz, record, points, centre - half, 2 * half, depth, each)
        end = stream.seek(0, 2)
        pages = [cells]
        if in_pages:
            pages = _pages_of_octants(cells, end + 60)
        hierarchy = b"".join(ENTRY.pack(*cell) for page in pages for cell in page)
        head = struct.pack("<H16sHQ32s", 0, b"copc", HIERARCHY, len(hierarchy), b"")
        stream.write(head + hierarchy)
        write_header(end + 60, ENTRY.size * len(pages[0]))


def _pages_of_octants(cells, start):
    """Return the entries of the first page, and of one page for each octant behind it."""
    root, *others = cells
    octants: dict[tuple[int, int, int], list[tuple[int, ...]]] = {}
    for cell in others:
        level, x, y, z, *_ = cell
        shift = level - 1
        octant = (x >> shift, y >> shift, z >> shift)
        octants.setdefault(octant, []).append(cell)
    first_page = [root]
    start += ENTRY.size * (1 + len(octants))
    for octant, page in octants.items():
        size = ENTRY.size * len(page)
        first_page.append((1, *octant, start, size, -1))
        start += size
    return [first_page, *octants.values()]


def _write_cells(stream, laz, record, points, corner, side, depth, each):
    """Write the points of every cell, and return the entries of the octree's page."""
    compressor = lazrs.LasZipCompressor(stream, laz)
    compressor.reserve_offset_to_chunk_table()
    left = np.arange(len(points))
    entries = []
    for level in range(depth + 1):
        cells_of_side = 2**level
        keys = ((points[left] - corner) / side * cells_of_side).astype(int)
        taken = []
        for key in np.unique(keys, axis=0):
            is_in_cell = (keys == key).all(1)
            rows = left[is_in_cell]
            if level < depth:
                rows = rows[:each]
            start = stream.tell()
            chunk = record.array[rows].tobytes()
            compressor.compress_many(np.frombuffer(chunk, np.uint8))
            compressor.finish_current_chunk()
            size = stream.tell() - start
            entries.append((level, *key, start, size, len(rows)))
            taken.append(rows)
        left = np.setdiff1d(left, np.concatenate(taken))
    compressor.done()
    return entries
