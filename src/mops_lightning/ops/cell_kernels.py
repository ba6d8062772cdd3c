"""Voxels, and points of a smallest distance, in loops that numba compiles.

``ops.voxels`` and ``ops.spacing`` call them. Arrays have one dimension, which halves the time of
compilation. All functions are in this file, because numba does not notice that a cached function
calls one that has changed in another file.
"""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.jit import jit, jit_cached

STEPS = 2.0**36
"""Steps per side of a voxel, to which the means of its points are exact."""

UNSEEN = 0
NEAR = 1
KEPT = 2
"""States of a point: no kept point is near so far, one is, or it is kept."""

MIX_X = 0x1B873593CC9E2D51
MIX_Y = -0x61C8864680B583EB
MIX_Z = 0x2545F4914F6CDD1D
"""Odd factors, of which the high bits of products are well mixed."""


@jit
def _slot(x, y, z, mask):
    """Return where the search for a place begins in a table of mask + 1 slots."""
    mixed = x * MIX_X + y * MIX_Y + z * MIX_Z
    return (mixed >> 32) & mask


@jit
def _larger_table(places, table):
    """Return a table of twice the size for the same places."""
    larger = np.full(2 * len(table), -1, np.int32)
    mask = len(larger) - 1
    for cell in range(len(places) // 3):
        x = places[3 * cell]
        y = places[3 * cell + 1]
        z = places[3 * cell + 2]
        slot = _slot(x, y, z, mask)
        while larger[slot] >= 0:
            slot = (slot + 1) & mask
        larger[slot] = cell
    return larger


@jit
def _larger_places(places):
    """Return the places with room for as many again."""
    larger = np.empty(2 * len(places), np.int64)
    for i in range(len(places)):
        larger[i] = places[i]
    return larger


@jit_cached
def group(points, size):
    """Return the voxel of every point, the places of the voxels, and a table of them by hash.

    The search of the table is written out, because a call with arrays takes 40 ns.
    """
    number = len(points) // 3
    cell_of = np.empty(number, np.int32)
    places = np.empty(3 * 512, np.int64)
    table = np.full(1024, -1, np.int32)
    known = 0
    for i in range(number):
        x = np.int64(np.floor(points[3 * i] / size))
        y = np.int64(np.floor(points[3 * i + 1] / size))
        z = np.int64(np.floor(points[3 * i + 2] / size))
        mask = len(table) - 1
        slot = _slot(x, y, z, mask)
        cell = table[slot]
        while cell >= 0:
            at = 3 * cell
            if places[at] == x and places[at + 1] == y and places[at + 2] == z:
                break
            slot = (slot + 1) & mask
            cell = table[slot]
        if cell < 0:
            cell = known
            table[slot] = cell
            places[3 * cell] = x
            places[3 * cell + 1] = y
            places[3 * cell + 2] = z
            known += 1
            if 3 * known == len(places):  # the table is half full
                table = _larger_table(places, table)
                places = _larger_places(places)
        cell_of[i] = cell
    return cell_of, places[: 3 * known], table


@jit
def _steps_inside(value, size):
    """Return how far inside its voxel a coordinate is."""
    place = value / size
    inside = place - np.floor(place)
    return np.int64(inside * STEPS)


@jit_cached
def add_up(points, size, cell_of, known):
    """Return the number of points of every voxel, and their sums."""
    counts = np.zeros(known, np.int64)
    sums = np.zeros(3 * known, np.int64)
    for i in range(len(cell_of)):
        cell = cell_of[i]
        counts[cell] += 1
        for axis in range(3):
            coordinate = points[3 * i + axis]
            sums[3 * cell + axis] += _steps_inside(coordinate, size)
    return counts, sums


@jit
def _is_lower(points, i, j):
    """Return whether the coordinates of point i come before those of point j."""
    for axis in range(3):
        a = points[3 * i + axis]
        b = points[3 * j + axis]
        if a != b:
            return a < b
    return False


@jit_cached
def nearest(points, size, cell_of, means, weight):
    """Return the chosen row of every voxel, and its squared distance from the mean."""
    known = len(means) // 3
    rows = np.full(known, -1, np.int64)
    best = np.full(known, np.inf)
    for i in range(len(cell_of)):
        cell = cell_of[i]
        row = rows[cell]
        if len(weight) and row >= 0:
            if weight[i] < weight[row]:
                continue
            if weight[i] > weight[row]:
                best[cell] = np.inf
        squared = 0.0
        for axis in range(3):
            inside = _steps_inside(points[3 * i + axis], size)
            difference = inside - means[3 * cell + axis]
            squared += difference * difference
        is_tied = squared == best[cell]
        if squared < best[cell] or (is_tied and _is_lower(points, i, row)):
            best[cell] = squared
            rows[cell] = i
    return rows, best


@jit_cached
def hashes_of(bits, channels, seed):
    """Hash every point, by the finalizer of SplitMix64 once for every coordinate."""
    out = np.empty(len(bits) // channels, np.uint64)
    first = np.uint64(0xBF58476D1CE4E5B9)
    second = np.uint64(0x94D049BB133111EB)
    step = np.uint64(0x9E3779B97F4A7C15)
    begin = (seed + np.uint64(1)) * step
    for i in range(len(out)):
        key = begin
        for c in range(channels):
            value = bits[i * channels + c]
            key = (key ^ value) + step
            key = (key ^ (key >> np.uint64(30))) * first
            key = (key ^ (key >> np.uint64(27))) * second
            key = key ^ (key >> np.uint64(31))
        out[i] = key
    return out


@jit
def _comes_first(i, j, hashes, points, channels):
    """Return whether row i comes before row j."""
    if hashes[i] != hashes[j]:
        return hashes[i] < hashes[j]
    for c in range(channels):
        a = points[i * channels + c]
        b = points[j * channels + c]
        if a != b:
            return a < b
    return i < j


@jit_cached
def sort_ties(order, hashes, row_bits, points, channels):
    """Sort rows whose hashes have the same high bits."""
    for k in range(1, len(order)):
        row = order[k]
        j = k
        while (
            j > 0
            and hashes[order[j - 1]] >> row_bits == hashes[row] >> row_bits
            and _comes_first(row, order[j - 1], hashes, points, channels)
        ):
            order[j] = order[j - 1]
            j -= 1
        order[j] = row


@jit_cached
def sort_by_cell(points, channels, cell_of, known):
    """Sort points by their cell.

    Returns:
        The coordinates ``(N·C,)``, one point after the other, the place ``(N,)`` of every row among
        the sorted points, and where in these each cell starts ``(K + 1,)``.
    """
    number = len(cell_of)
    starts = np.zeros(known + 2, np.int64)
    for i in range(number):
        starts[cell_of[i] + 2] += 1
    for cell in range(known):
        starts[cell + 2] += starts[cell + 1]
    ordered = np.empty(len(points))
    places = np.empty(number, np.int64)
    for i in range(number):
        place = starts[cell_of[i] + 1]
        starts[cell_of[i] + 1] += 1
        places[i] = place
        for c in range(channels):
            ordered[channels * place + c] = points[channels * i + c]
    return ordered, places, starts


@jit_cached
def visit(points, channels, places, starts, cell_of, cells, table, order, limit):
    """Keep every point of the order to which no kept point is near; return all states.

    Args:
        points: ``(N·C,)`` coordinates from ``sort_by_cell``; the first three axes have cells.
        channels: C, at least 3.
        places: see ``sort_by_cell``.
        starts: see there.
        cell_of: ``(N,)`` cell of every row.
        cells: ``(3·K,)`` places of the cells from ``group``.
        table: see there.
        order: rows to visit.
        limit: squared distance of points that are not near any more.

    Returns:
        ``(N,)`` uint8 state of every row.
    """
    number = len(places)
    mask = len(table) - 1
    seen = np.zeros(number, np.uint8)
    for k in range(len(order)):
        row = order[k]
        place = places[row]
        if seen[place] != UNSEEN:
            continue
        at = channels * place
        own_x = points[at]
        own_y = points[at + 1]
        own_z = points[at + 2]
        home = 3 * cell_of[row]
        for neighbour in range(27):
            x = cells[home] + neighbour // 9 - 1
            y = cells[home + 1] + neighbour // 3 % 3 - 1
            z = cells[home + 2] + neighbour % 3 - 1
            slot = _slot(x, y, z, mask)
            cell = table[slot]
            while cell >= 0:
                other = 3 * cell
                if cells[other] == x and cells[other + 1] == y and cells[other + 2] == z:
                    break
                slot = (slot + 1) & mask
                cell = table[slot]
            if cell >= 0:
                for i in range(starts[cell], starts[cell + 1]):
                    first = channels * i
                    dx = points[first] - own_x
                    dy = points[first + 1] - own_y
                    dz = points[first + 2] - own_z
                    squared = dx * dx + dy * dy + dz * dz
                    for c in range(3, channels):
                        difference = points[first + c] - points[at + c]
                        squared += difference * difference
                    if squared < limit:
                        seen[i] = NEAR
        seen[place] = KEPT
    states = np.empty(number, np.uint8)
    for i in range(number):
        states[i] = seen[places[i]]
    return states
