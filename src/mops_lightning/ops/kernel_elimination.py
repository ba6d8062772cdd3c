"""Sample elimination in loops that numba compiles; ``samplers.poisson`` calls them.

Points are sorted by cubic cells, and the points of a cell are contiguous, so that the loops over
them are vectorised. The most crowded point is found by the largest crowding of every cell and of
every group of cells, which needs no heap: a removal changes a few cells only.
"""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.jit import float_bits, jit, jit_cached, jit_inlined

GROUP = 64
"""Number of cells of a group."""

EMPTY = -1
"""The largest crowding of a cell without points."""

TINY = 2.3e-308
"""Above the least normal number."""

WHOLE = 2.0**52
"""The bits of 2⁵² + k are those of 2⁵² plus k."""


@jit_inlined
def _weight(squared, inverse, scale):
    """Return ⌊(1 − d/reach)⁸ · scale⌋ as an integer, without a branch, so that it is vectorised.

    A product with 1/reach takes less than half the time of a quotient.
    """
    share = max(1.0 - np.sqrt(squared) * inverse, 0.0)
    share *= share
    share *= share
    return float_bits(np.floor(share * share * scale) + WHOLE) - float_bits(WHOLE)


@jit
def _write_squares(planes, size, start, stop, place, squares):
    """Write the squared distances of the points from start to stop to that of a place."""
    channels = len(planes) // size
    x, y, z = planes[place], planes[size + place], planes[2 * size + place]
    xs = planes[start:stop]
    ys = planes[size + start : size + stop]
    zs = planes[2 * size + start : 2 * size + stop]
    for i in range(len(xs)):
        dx = xs[i] - x
        dy = ys[i] - y
        dz = zs[i] - z
        squares[i] = dx * dx + dy * dy + dz * dz
    for axis in range(3, channels):
        line, at = planes[axis * size + start : axis * size + stop], planes[axis * size + place]
        for i in range(len(line)):
            difference = line[i] - at
            squares[i] += difference * difference


@jit
def _write_weights(squares, inverse, scale, weights):
    """Write the weights of squared distances; all cells in one loop, because cells are small."""
    for i in range(len(squares)):
        weights[i] = _weight(squares[i], inverse, scale)


@jit
def _largest(crowding, shares):
    """Return the largest crowding, multiplied by the shares, which may be ``(0,)``."""
    top = np.int64(EMPTY)
    if len(shares):
        for i in range(len(crowding)):
            top = max(top, np.int64(crowding[i] * shares[i]))
    else:
        for i in range(len(crowding)):
            top = max(top, crowding[i])
    return top


@jit
def _lowest_row(rows, crowding, shares, top, lowest):
    """Return the place of the lowest row with the largest crowding, if it is below ``lowest``."""
    found = -1
    for i in range(len(rows)):
        value = np.int64(crowding[i] * shares[i]) if len(shares) else crowding[i]
        if value == top and rows[i] < lowest:
            found, lowest = i, rows[i]
    return found, lowest


@jit
def _boxes(planes, size, starts):
    """Return the lowest and the highest coordinates ``(6·K,)`` of every cell."""
    boxes = np.empty(6 * (len(starts) - 1))
    for cell in range(len(starts) - 1):
        for axis in range(3):
            line = planes[axis * size + starts[cell] : axis * size + starts[cell + 1]]
            low = high = line[0]
            for i in range(len(line)):
                low = min(low, line[i])
                high = max(high, line[i])
            boxes[6 * cell + 2 * axis] = low
            boxes[6 * cell + 2 * axis + 1] = high
    return boxes


@jit
def _is_near(planes, size, place, boxes, cell, limit):
    """Return whether a squared distance of a point to those of a cell can be below a limit."""
    total = 0.0
    for axis in range(3):
        at = planes[axis * size + place]
        low, high = boxes[6 * cell + 2 * axis], boxes[6 * cell + 2 * axis + 1]
        outside = max(max(low - at, at - high), 0.0)
        total += outside * outside
    return total <= limit


@jit
def _gather(planes, size, place, starts, ends, cells, squares):
    """Write the squared distances of all points of some cells to that of a place; their number."""
    count = 0
    for cell in cells:
        start, end = starts[cell], ends[cell]
        _write_squares(planes, size, start, end, place, squares[count:])
        count += end - start
    return count


@jit
def _near_cells(planes, size, place, boxes, around, limit, lowest, near):
    """Write the cells from ``lowest`` on that can be near a point; return their number."""
    count = 0
    for cell in around:
        if cell >= lowest and _is_near(planes, size, place, boxes, cell, limit):
            near[count] = cell
            count += 1
    return count


@jit
def _crowdings(planes, starts, around, boxes, limit, inverse, scale, squares, weights, crowding):
    """Write the crowding of every point; every pair of points is visited once."""
    size, near = len(crowding), np.empty(27, np.int64)
    for cell in range(len(starts) - 1):
        cells = around[27 * cell : 27 * (cell + 1)]
        for place in range(starts[cell], starts[cell + 1]):
            own = starts[cell + 1] - place
            _write_squares(planes, size, place, starts[cell + 1], place, squares)
            known = _near_cells(planes, size, place, boxes, cells, limit, cell + 1, near)
            count = own + _gather(
                planes, size, place, starts, starts[1:], near[:known], squares[own:]
            )
            _write_weights(squares[:count], inverse, scale, weights)
            total = np.int64(0)
            for i in range(count):
                total += weights[i]
            crowding[place] += total - weights[0]  # the point itself is added below
            _add(crowding[place:], weights[:own])
            begin = own
            for k in range(known):
                start, stop = starts[near[k]], starts[near[k] + 1]
                _add(crowding[start:], weights[begin : begin + stop - start])
                begin += stop - start


@jit
def _add(crowding, weights):
    for i in range(len(weights)):
        crowding[i] += weights[i]


@jit
def _take(crowding, weights):
    for i in range(len(weights)):
        crowding[i] -= weights[i]


@jit
def _group_top(tops, group):
    part = tops[GROUP * group : GROUP * (group + 1)]
    top = np.int64(EMPTY)
    for i in range(len(part)):
        top = max(top, part[i])
    return top


@jit
def _most_crowded(tops, group_tops, starts, ends, rows, crowding, shares):
    """Return the cell and the place of the most crowded point, the lowest row in case of ties."""
    top = np.int64(EMPTY)
    for group in range(len(group_tops)):
        top = max(top, group_tops[group])
    lowest = np.int64(len(rows))
    best_cell, best = 0, 0
    for group in range(len(group_tops)):
        if group_tops[group] != top:
            continue
        for cell in range(GROUP * group, min(GROUP * (group + 1), len(tops))):
            if tops[cell] == top:
                start, end = starts[cell], ends[cell]
                part = shares[start:end]
                found, lowest = _lowest_row(rows[start:end], crowding[start:end], part, top, lowest)
                if found >= 0:
                    best_cell, best = cell, start + found
    return best_cell, best


@jit
def _fill_gap(planes, size, place, last, rows, crowding, shares):
    """Move the last point of a cell to the place of a removed one."""
    for axis in range(len(planes) // size):
        planes[axis * size + place] = planes[axis * size + last]
    rows[place] = rows[last]
    crowding[place] = crowding[last]
    if len(shares):
        shares[place] = shares[last]


@jit_cached
def eliminate(planes, rows, starts, around, shares, m, reach, scale):
    """Remove the most crowded point until m remain.

    Args:
        planes: ``(C·N,)`` coordinates, one axis after the other, C ≥ 3, of points that are sorted
            by the cell of the first three axes; changed.
        rows: ``(N,)`` rows of the points: the lowest is removed in case of ties; changed.
        starts: ``(K + 1,)`` first point of every cell, and N.
        around: ``(27·K,)`` cells with all points nearer than ``reach``; -1 for none.
        shares: ``(N,)`` factors of the crowding, from 0 to 1, or ``(0,)``; changed.
        m: number of points that remain.
        reach: distance from which weights are 0, positive.
        scale: factor of the weights before they are truncated to integers.

    Returns:
        ``(N,)`` whether each row remains.
    """
    size, cells = len(rows), len(starts) - 1
    crowding, squares, weights = np.zeros(size, np.int64), np.empty(size), np.empty(size, np.int64)
    boxes = _boxes(planes, size, starts)
    inverse = 1.0 / reach
    limit = reach * reach * (1 + 1e-12) + TINY  # weights beyond are 0, whatever the rounding
    _crowdings(planes, starts, around, boxes, limit, inverse, scale, squares, weights, crowding)
    ends, tops = np.empty(cells, np.int64), np.empty(cells, np.int64)
    for cell in range(cells):
        start, ends[cell] = starts[cell], starts[cell + 1]
        tops[cell] = _largest(crowding[start : ends[cell]], shares[start : ends[cell]])
    group_tops = np.empty((cells + GROUP - 1) // GROUP, np.int64)
    for group in range(len(group_tops)):
        group_tops[group] = _group_top(tops, group)
    remains, near = np.ones(size, np.bool_), np.empty(27, np.int64)
    for _ in range(size - m):
        home, place = _most_crowded(tops, group_tops, starts, ends, rows, crowding, shares)
        remains[rows[place]] = False
        cells = around[27 * home : 27 * (home + 1)]
        known = _near_cells(planes, size, place, boxes, cells, limit, 0, near)
        count = _gather(planes, size, place, starts, ends, near[:known], squares)
        _write_weights(squares[:count], inverse, scale, weights)
        begin = 0
        for k in range(known):
            start, end = starts[near[k]], ends[near[k]]
            _take(crowding[start:], weights[begin : begin + end - start])
            begin += end - start
        ends[home] -= 1
        _fill_gap(planes, size, place, ends[home], rows, crowding, shares)
        for k in range(known):
            cell = near[k]
            before, start, end = tops[cell], starts[cell], ends[cell]
            tops[cell] = _largest(crowding[start:end], shares[start:end])
            if before == group_tops[cell // GROUP]:
                group_tops[cell // GROUP] = _group_top(tops, cell // GROUP)
    return remains
