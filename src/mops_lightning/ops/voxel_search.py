"""The largest voxels of which at least m are occupied, in loops that numba compiles.

All functions are in this file, because numba does not notice that a cached function calls one that
has changed in another file.
"""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.jit import jit, jit_cached

MIX = -0x61C8864680B583EB
"""2⁶⁴ divided by the golden ratio, odd; the high bits of products are well mixed."""

TOLERANCE = 1 + 1e-6
"""Ratio of squared distances that count as equal: two points are equally far from their mean."""


@jit
def _key(x, y, z, scale):
    """Return the voxel of a position in the unit cube, in ascending (x, y, z) order."""
    return (np.int64(x * scale) << 42) + (np.int64(y * scale) << 21) + np.int64(z * scale)


@jit_cached
def reaches(spans, scale, m):
    """Return whether at least m voxels are occupied.

    Args:
        spans: ``(3·N,)`` positions in the unit cube, one after the other.
        scale: number of voxels per side, of the same type.
        m: number of voxels.
    """
    size, shift = 1024, 54  # the highest bits of a product depend on all bits of the key
    while size < 2 * m:
        size *= 2
        shift -= 1
    table = np.full(size, -1, np.int64)
    known = 0
    last = -1
    for i in range(len(spans) // 3):
        key = _key(spans[3 * i], spans[3 * i + 1], spans[3 * i + 2], scale)
        if key == last:
            continue
        last = key
        slot = ((key * MIX) >> shift) & (size - 1)
        while table[slot] >= 0 and table[slot] != key:
            slot = (slot + 1) & (size - 1)
        if table[slot] < 0:
            table[slot] = key
            known += 1
            if known == m:
                return True
    return False


@jit_cached
def group(spans, scale):
    """Return the voxel ``(N,)`` of every point, numbered as they are met, and their keys."""
    number = len(spans) // 3
    size, shift = 1024, 54
    while size < 2 * number:
        size *= 2
        shift -= 1
    table = np.full(size, -1, np.int32)
    cell_of = np.empty(number, np.int32)
    keys = np.empty(number, np.int64)
    known = 0
    for i in range(number):
        key = _key(spans[3 * i], spans[3 * i + 1], spans[3 * i + 2], scale)
        slot = ((key * MIX) >> shift) & (size - 1)
        while table[slot] >= 0 and keys[table[slot]] != key:
            slot = (slot + 1) & (size - 1)
        if table[slot] < 0:
            table[slot] = known
            keys[known] = key
            known += 1
        cell_of[i] = table[slot]
    return cell_of, keys[:known]


@jit_cached
def sort_by_cell(spans, cell_of, known):
    """Return the positions voxel by voxel, so that most keys are equal to the ones before them."""
    starts = np.zeros(known + 1, np.int64)
    for i in range(len(cell_of)):
        starts[cell_of[i] + 1] += 1
    for cell in range(known):
        starts[cell + 1] += starts[cell]
    ordered = np.empty_like(spans)
    for i in range(len(cell_of)):
        place = starts[cell_of[i]]
        starts[cell_of[i]] += 1
        for axis in range(3):
            ordered[3 * place + axis] = spans[3 * i + axis]
    return ordered


@jit
def _steps(points, low, i, axis, unit):
    """Return a coordinate as a whole number, so that sums do not depend on the order."""
    return np.int64((points[3 * i + axis] - low[axis]) * unit)


@jit_cached
def nearest_to_means(points, cell_of, known, hashes, bits):
    """Return the number of points of every voxel, and the point nearest to their mean.

    Args:
        points: ``(3·N,)`` float64, one point after the other.
        cell_of: ``(N,)`` voxel of every point.
        known: number of voxels.
        hashes: ``(N,)``; the lowest one is chosen among points that are equally near.
        bits: of a coordinate, so many that the sums of all points have 63.
    """
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for i in range(len(cell_of)):
        for axis in range(3):
            low[axis] = min(low[axis], points[3 * i + axis])
            high[axis] = max(high[axis], points[3 * i + axis])
    side = max(high[0] - low[0], high[1] - low[1], high[2] - low[2])
    unit = 2.0**bits / side if side > 0 else 1.0
    counts = np.zeros(known, np.int64)
    sums = np.zeros(3 * known, np.int64)
    for i in range(len(cell_of)):
        cell = cell_of[i]
        counts[cell] += 1
        for axis in range(3):
            sums[3 * cell + axis] += _steps(points, low, i, axis, unit)
    squared = np.empty(len(cell_of))
    smallest = np.full(known, np.inf)
    for i in range(len(cell_of)):
        cell = cell_of[i]
        total = 0.0
        for axis in range(3):
            mean = sums[3 * cell + axis] / counts[cell]
            difference = _steps(points, low, i, axis, unit) - mean
            total += difference * difference
        squared[i] = total
        if total < smallest[cell]:
            smallest[cell] = total
    rows = np.full(known, -1, np.int64)
    for i in range(len(cell_of)):
        cell = cell_of[i]
        if squared[i] <= smallest[cell] * TOLERANCE and (
            rows[cell] < 0 or hashes[i] < hashes[rows[cell]]
        ):
            rows[cell] = i
    return counts, rows
