"""The largest voxels of which at least m are occupied, in loops that numba compiles.

All functions are in this file, because numba does not notice that a cached function calls one that
has changed in another file.
"""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.jit import jit, jit_cached, jit_inlined

MIX = -0x61C8864680B583EB
"""2⁶⁴ divided by the golden ratio, odd; the high bits of products are well mixed."""

TOLERANCE = 1 + 1e-6
"""Ratio of squared distances that count as equal: two points are equally far from their mean."""


@jit
def _key(x, y, z, scale):
    """Return the voxel of a position in the unit cube, in ascending (x, y, z) order."""
    x_part = np.int64(x * scale) << 42
    y_part = np.int64(y * scale) << 21
    return x_part + y_part + np.int64(z * scale)


@jit_cached
def in_unit_cube(points, tiny):
    """Return points ``(3·N,)``, one after the other, in the unit cube around them.

    Args:
        points: of at least one point.
        tiny: smallest side of the cube, of the same type.
    """
    low = points[:3].copy()
    high = points[:3].copy()
    for i in range(len(points) // 3):
        for axis in range(3):
            coordinate = points[3 * i + axis]
            low[axis] = min(low[axis], coordinate)
            high[axis] = max(high[axis], coordinate)
    side = max(high[0] - low[0], high[1] - low[1], high[2] - low[2], tiny)
    spans = np.empty_like(points)
    for i in range(len(points) // 3):
        for axis in range(3):
            offset = points[3 * i + axis] - low[axis]
            spans[3 * i + axis] = offset / side
    return spans


@jit_inlined
def _enter(key, table, shift):
    """Enter a key into a table, and return its slot, or -1 if the table holds it."""
    mask = len(table) - 1
    slot = ((key * MIX) >> shift) & mask  # the highest bits of a product depend on the whole key
    while table[slot] >= 0 and table[slot] != key:
        slot = (slot + 1) & mask
    if table[slot] == key:
        return -1
    table[slot] = key
    return slot


@jit_cached
def reaches(spans, scale, wanted, table, shift):
    """Return whether at least so many voxels are occupied that a table does not hold.

    Args:
        spans: ``(3·N,)`` positions in the unit cube, one after the other.
        scale: number of voxels per side, of the same type.
        wanted: number of voxels, at least 1 and at most half the size of the table.
        table: keys of other voxels, and -1 in free slots; it is left as it was.
        shift: 64 less the number of bits of the table's size.
    """
    slots = np.empty(wanted, np.int64)
    known = 0
    last = -1
    for i in range(len(spans) // 3):
        x = spans[3 * i]
        y = spans[3 * i + 1]
        z = spans[3 * i + 2]
        key = _key(x, y, z, scale)
        if key == last:
            continue
        last = key
        slot = _enter(key, table, shift)
        if slot >= 0:
            slots[known] = slot
            known += 1
            if known == wanted:
                break
    for i in range(known):
        table[slots[i]] = -1
    return known == wanted


@jit_cached
def settle(spans, coarse, fine, table, shift):
    """Enter into a table the voxels of positions that are in the same one at two scales.

    A coordinate's voxel never decreases with the scale. Therefore these positions are in their
    voxels at all scales between the two.

    Args:
        spans: as for ``reaches``.
        coarse: the smaller scale.
        fine: the larger scale.
        table: keys of voxels; at most half of it will be in use.
        shift: as for ``reaches``.

    Returns:
        The other positions, and the number of voxels that were entered.
    """
    others = np.empty_like(spans)
    left = 0
    entered = 0
    last = -1
    for i in range(len(spans) // 3):
        x = spans[3 * i]
        y = spans[3 * i + 1]
        z = spans[3 * i + 2]
        key = _key(x, y, z, coarse)
        if key != _key(x, y, z, fine):
            others[left] = x
            others[left + 1] = y
            others[left + 2] = z
            left += 3
        elif key != last:
            last = key
            if _enter(key, table, shift) >= 0:
                entered += 1
    return others[:left], entered


@jit_cached
def group(spans, scale):
    """Return the voxel ``(N,)`` of every point, numbered as they are met, and their keys."""
    number = len(spans) // 3
    size = 1024
    shift = 54
    while size < 2 * number:
        size *= 2
        shift -= 1
    table = np.full(size, -1, np.int32)
    cell_of = np.empty(number, np.int32)
    keys = np.empty(number, np.int64)
    known = 0
    for i in range(number):
        x = spans[3 * i]
        y = spans[3 * i + 1]
        z = spans[3 * i + 2]
        key = _key(x, y, z, scale)
        slot = ((key * MIX) >> shift) & (size - 1)
        while table[slot] >= 0 and keys[table[slot]] != key:
            slot = (slot + 1) & (size - 1)
        if table[slot] < 0:
            table[slot] = known
            keys[known] = key
            known += 1
        cell_of[i] = table[slot]
    return cell_of, keys[:known]


@jit
def _steps(points, low, i, axis, unit):
    """Return a coordinate as a whole number, so that sums do not depend on the order."""
    offset = points[3 * i + axis] - low[axis]
    return np.int64(offset * unit)


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
            coordinate = points[3 * i + axis]
            low[axis] = min(low[axis], coordinate)
            high[axis] = max(high[axis], coordinate)
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
        is_nearest = squared[i] <= smallest[cell] * TOLERANCE
        row = rows[cell]
        if is_nearest and (row < 0 or hashes[i] < hashes[row]):
            rows[cell] = i
    return counts, rows
