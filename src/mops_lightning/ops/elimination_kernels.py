"""Sample elimination in loops that numba compiles; ``ops.elimination`` calls them."""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.kernels import cached, jit


@jit
def _change(planes, starts, numbers, near, sign, reach, scale, x, y, z, crowding):
    """Add weights to the crowding of all points around a place, and return their sum."""
    limit = reach * reach * (1 + 1e-12) + 2.3e-308  # weights beyond are 0, whatever the rounding
    total = np.int64(0)
    for k in range(len(near)):
        cell = near[k]
        if cell >= 0:
            for i in range(starts[cell], starts[cell] + numbers[cell]):
                dx, dy, dz = planes[0, i] - x, planes[1, i] - y, planes[2, i] - z
                squared = dx * dx + dy * dy + dz * dz
                if squared <= limit:
                    share = max(1.0 - np.sqrt(squared) / reach, 0.0)
                    share *= share
                    share *= share
                    weight = np.int64(share * share * scale)
                    crowding[i] += sign * weight
                    total += weight
    return total


@jit
def _sink(heap, keys, order, top):
    """Restore the order of a heap below an entry whose key has become smaller."""
    place = heap[top]
    while True:
        child = 2 * top + 1
        if child >= len(heap):
            break
        other = child + 1
        if other < len(heap) and _before(keys, order, heap[other], heap[child]):
            child = other
        if not _before(keys, order, heap[child], place):
            break
        heap[top] = heap[child]
        top = child
    heap[top] = place


@jit
def _before(keys, order, one, other):
    return keys[one] > keys[other] or (keys[one] == keys[other] and order[one] < order[other])


@cached
def eliminate(planes, order, starts, numbers, cell_of, around, m, reach, scale):
    """Remove the most crowded point until m remain.

    Args:
        planes: ``(3, N)`` coordinates of points that are sorted by their cell; changed.
        order: ``(N,)`` their rows; the lowest row is removed in case of ties.
        starts: ``(K,)`` first point of every cell.
        numbers: ``(K,)`` number of points of every cell; changed.
        cell_of: ``(N,)`` cell of every point.
        around: ``(K, 27)`` cells with all points nearer than ``reach``; -1 for none.
        m: number of points that remain.
        reach: distance from which weights are 0, positive.
        scale: factor of the weights before they are truncated to integers.

    Returns:
        ``(N,)`` whether each row remains.
    """
    size = len(order)
    crowding, keys, nothing = np.zeros(size, np.int64), np.empty(size, np.int64), np.int64(0)
    for point in range(size):
        x, y, z = planes[0, point], planes[1, point], planes[2, point]
        near = around[cell_of[point]]
        keys[point] = _change(
            planes, starts, numbers, near, nothing, reach, scale, x, y, z, crowding
        )
    # Removed points move to the end of their cell: ``at`` is where each point is now.
    heap, at, here = np.arange(size), np.arange(size), np.arange(size)
    for i in range(size):
        crowding[i] = keys[i]
    for top in range(size // 2 - 1, -1, -1):
        _sink(heap, keys, order, top)
    remains = np.ones(size, np.bool_)
    left = size
    while left > m:
        point = heap[0]
        place = at[point]
        if keys[point] != crowding[place]:
            # Crowding only falls: a key is an upper bound, and is corrected when it is the largest.
            keys[point] = crowding[place]
        else:
            x, y, z = planes[0, place], planes[1, place], planes[2, place]
            cell = cell_of[point]
            numbers[cell] -= 1
            last = starts[cell] + numbers[cell]
            for axis in range(3):
                planes[axis, place] = planes[axis, last]
            crowding[place], here[place] = crowding[last], here[last]
            at[here[place]] = place
            near = around[cell]
            _change(planes, starts, numbers, near, np.int64(-1), reach, scale, x, y, z, crowding)
            remains[order[point]] = False
            keys[point] = -1  # sinks to the bottom
            left -= 1
        _sink(heap, keys, order, 0)
    return remains
