"""Sample elimination in loops that numba compiles; ``samplers.poisson`` calls them.

Points are in the order of a curve, and consecutive ones form a block with a box. Lists of the
blocks that can be near each block are made once, and again whenever a third of the points are
removed. The most crowded point is found by the largest crowding of every block and of every group
of blocks, which needs no heap: a removal changes a few blocks only.
"""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops import lanes
from mops_lightning.ops.jit import jit, jit_cached_with, jit_inlined
from mops_lightning.ops.lanes import add_weights, take_weights

BLOCK = 32
"""Smallest number of points of a block, a multiple of the lanes."""

GROUP = 32
"""Number of blocks of a group."""

LISTED = 128
"""Mean number of near blocks from which blocks of twice the size are taken."""

KEPT_SHARE = 0.7
"""Share of the points that is left when blocks are formed again."""

GONE = -(2**62)
"""Crowding of removed points: negative, even after further subtractions."""


@jit
def _top(values):
    """Return the largest value."""
    top = np.int64(GONE)
    for i in range(len(values)):
        top = max(top, values[i])
    return top


@jit
def _shared_top(crowding, shares):
    """Return the largest crowding multiplied by the share."""
    top = np.int64(GONE)
    for i in range(len(crowding)):
        shared = np.int64(crowding[i] * shares[i])
        top = max(top, shared)
    return top


@jit
def _boxes(planes, total, number, size):
    """Return the lowest and the highest coordinates ``(6·K,)`` of every block."""
    boxes = np.empty(6 * (total // size))
    for block in range(total // size):
        start = block * size
        stop = min(start + size, number)
        for axis in range(3):
            line = planes[axis * total + start : axis * total + stop]
            low = high = line[0]
            for i in range(len(line)):
                low = min(low, line[i])
                high = max(high, line[i])
            first = 6 * block + 2 * axis
            boxes[first] = low
            boxes[first + 1] = high
    return boxes


@jit
def _group_boxes(boxes):
    """Return the boxes of groups of blocks."""
    blocks = len(boxes) // 6
    groups = (blocks + GROUP - 1) // GROUP
    around = np.empty(6 * groups)
    for group in range(groups):
        first = GROUP * group
        stop = min(first + GROUP, blocks)
        for side in range(6):
            edge = boxes[6 * first + side]
            for block in range(first, stop):
                other = boxes[6 * block + side]
                if side % 2:
                    edge = max(edge, other)
                else:
                    edge = min(edge, other)
            around[6 * group + side] = edge
    return around


@jit_inlined
def _are_near(boxes, one, others, other, limit):
    """Return whether two boxes are nearer than the root of the limit."""
    total = 0.0
    for axis in range(3):
        low = boxes[6 * one + 2 * axis]
        high = boxes[6 * one + 2 * axis + 1]
        other_low = others[6 * other + 2 * axis]
        other_high = others[6 * other + 2 * axis + 1]
        gap = max(max(low - other_high, other_low - high), 0.0)
        total += gap * gap
    return total <= limit


@jit_inlined
def _is_near(x, y, z, boxes, block, limit):
    """Return whether a point is nearer to a box than the root of the limit."""
    first = 6 * block
    dx = max(max(boxes[first] - x, x - boxes[first + 1]), 0.0)
    dy = max(max(boxes[first + 2] - y, y - boxes[first + 3]), 0.0)
    dz = max(max(boxes[first + 4] - z, z - boxes[first + 5]), 0.0)
    return dx * dx + dy * dy + dz * dz <= limit


@jit
def _near_blocks(boxes, limit):
    """List the blocks near every block, itself included.

    Returns:
        Where each list starts ``(K + 1,)``, and the lists; an empty one where they are too long.
    """
    blocks = len(boxes) // 6
    most = max(LISTED, GROUP) * blocks
    around = _group_boxes(boxes)
    near_groups = np.empty(len(around) // 6, np.int64)
    starts = np.zeros(blocks + 1, np.int64)
    near = np.empty(most + GROUP, np.int32)
    known = 0
    for block in range(blocks):
        if block % GROUP == 0:
            count = 0
            for group in range(len(near_groups)):
                near_groups[count] = group
                count += _are_near(around, block // GROUP, around, group, limit)
        for k in range(count):
            if not _are_near(boxes, block, around, near_groups[k], limit):
                continue
            first = near_groups[k] * GROUP
            for other in range(first, min(first + GROUP, blocks)):
                near[known] = other
                known += _are_near(boxes, block, boxes, other, limit)
            if known > most:
                return starts, near[:0]
        starts[block + 1] = known
    return starts, near[:known]


@jit
def _crowdings(planes, axes, number, size, boxes, starts, near, limit, inverse, scale):
    """Return the crowding of every point, itself included; a pair of blocks is visited once."""
    total = len(planes) // axes
    crowding = np.zeros(total, np.int64)
    for block in range(total // size):
        start = block * size
        stop = start + size
        for place in range(start, min(stop, number)):
            add_weights(planes, total, axes, crowding, start, stop, place, inverse, scale)
        for k in range(starts[block], starts[block + 1]):
            other = near[k]
            if other <= block:
                continue
            start = other * size
            stop = start + size
            for place in range(block * size, (block + 1) * size):
                x = planes[place]
                y = planes[total + place]
                z = planes[2 * total + place]
                if _is_near(x, y, z, boxes, other, limit):
                    crowding[place] += add_weights(
                        planes, total, axes, crowding, start, stop, place, inverse, scale
                    )
    for place in range(number, total):
        crowding[place] = GONE
    return crowding


@jit_inlined
def _only_place(values, start, stop, wanted):
    """Return the place of a value that occurs, or -1 if it occurs more than once."""
    places = np.int64(0)
    number = np.int64(0)
    for i in range(stop - start):
        is_wanted = np.int64(values[start + i] == wanted)
        places += is_wanted * i
        number += is_wanted
    return start + places if number == 1 else np.int64(-1)


@jit
def _lowest_row(start, stop, rows, crowding, shares, top, lowest):
    """Return the place of the lowest row with the largest crowding, if it is below ``lowest``."""
    found = -1
    for place in range(start, stop):
        value = crowding[place]
        if len(shares):
            value = np.int64(crowding[place] * shares[place])
        if value == top and rows[place] < lowest:
            found = place
            lowest = rows[place]
    return found, lowest


@jit
def _most_crowded(tops, group_tops, size, rows, crowding, shares):
    """Return the place of the most crowded point, the lowest row in case of ties."""
    top = _top(group_tops)
    if len(shares) == 0:
        place = _only_most_crowded(tops, group_tops, size, crowding, top)
        if place >= 0:
            return place
    lowest = np.int64(2**62)
    best = 0
    for group in range(len(group_tops)):
        if group_tops[group] != top:
            continue
        first = GROUP * group
        for block in range(first, min(first + GROUP, len(tops))):
            if tops[block] == top:
                start = block * size
                found, lowest = _lowest_row(
                    start, start + size, rows, crowding, shares, top, lowest
                )
                if found >= 0:
                    best = found
    return best


@jit_inlined
def _only_most_crowded(tops, group_tops, size, crowding, top):
    """Return the place of the only point with the largest crowding, or -1 in case of ties.

    The loops without branches take a third of the time of a search for ties.
    """
    place = _only_place(group_tops, 0, len(group_tops), top)
    if place >= 0:
        place = _only_place(tops, GROUP * place, min(GROUP * (place + 1), len(tops)), top)
    if place >= 0:
        place = _only_place(crowding, size * place, size * (place + 1), top)
    return place


@jit
def _remove(
    planes, axes, rows, crowding, shares, size, boxes, starts, near, count, limit, inverse, scale
):
    """Remove the most crowded point ``count`` times."""
    total = len(crowding)
    tops = np.empty(total // size, np.int64)
    for block in range(len(tops)):
        start = block * size
        stop = start + size
        if len(shares):
            tops[block] = _shared_top(crowding[start:stop], shares[start:stop])
        else:
            tops[block] = _top(crowding[start:stop])
    groups = (len(tops) + GROUP - 1) // GROUP
    group_tops = np.empty(groups, np.int64)
    for group in range(groups):
        tops_of_group = tops[GROUP * group : GROUP * (group + 1)]
        group_tops[group] = _top(tops_of_group)
    for _ in range(count):
        place = _most_crowded(tops, group_tops, size, rows, crowding, shares)
        x = planes[place]
        y = planes[total + place]
        z = planes[2 * total + place]
        crowding[place] = GONE
        if len(shares):
            shares[place] = 1.0
        home = place // size
        for k in range(starts[home], starts[home + 1]):
            block = near[k]
            if not _is_near(x, y, z, boxes, block, limit):
                continue
            start = block * size
            stop = start + size
            top = take_weights(planes, total, axes, crowding, start, stop, place, inverse, scale)
            if len(shares):
                top = _shared_top(crowding[start:stop], shares[start:stop])
            before = tops[block]
            group = block // GROUP
            tops[block] = top
            if before == group_tops[group] and top != before:
                tops_of_group = tops[GROUP * group : GROUP * (group + 1)]
                group_tops[group] = _top(tops_of_group)


@jit
def _blocks_of(planes, axes, rows, crowding, shares, number, size):
    """Copy the points that remain to blocks; the rest of the last block is gone, and far away."""
    total = (number + size - 1) // size * size
    new_planes = np.full(axes * total, np.inf)
    new_rows = np.full(total, 2**62)
    new_crowding = np.full(total, GONE)
    new_shares = np.ones(total if len(shares) else 0)
    before = len(rows)
    place = 0
    for i in range(before):
        if crowding[i] < 0:
            continue
        for axis in range(axes):
            new_planes[axis * total + place] = planes[axis * before + i]
        new_rows[place] = rows[i]
        new_crowding[place] = crowding[i]
        if len(shares):
            new_shares[place] = shares[i]
        place += 1
    return new_planes, new_rows, new_crowding, new_shares


@jit_cached_with(lanes)
def eliminate(planes, axes, rows, shares, m, limit, inverse, scale):
    """Remove the most crowded point until m remain.

    Args:
        planes: ``(C·N,)`` coordinates, one axis after the other, of points along a curve.
        axes: C ≥ 3.
        rows: ``(N,)`` rows of the points: the lowest is removed in case of ties.
        shares: ``(N,)`` factors of the crowding, from 0 to 1, or ``(0,)``.
        m: number of points that remain.
        limit: squared distance from which weights are 0.
        inverse: 1 / reach.
        scale: factor of the weights before they are truncated to integers.

    Returns:
        ``(m,)`` rows that remain, in the order of the curve.
    """
    number = len(rows)
    size = BLOCK
    crowding = np.zeros(number, np.int64)
    known = False
    while number > m:
        planes, rows, crowding, shares = _blocks_of(
            planes, axes, rows, crowding, shares, number, size
        )
        boxes = _boxes(planes, len(rows), number, size)
        starts, near = _near_blocks(boxes, limit)
        if not len(near):
            size *= 2
            continue
        if not known:
            crowding = _crowdings(
                planes, axes, number, size, boxes, starts, near, limit, inverse, scale
            )
            known = True
        share = int(number * (1 - KEPT_SHARE))
        count = min(number - m, max(share, 1))
        _remove(
            planes,
            axes,
            rows,
            crowding,
            shares,
            size,
            boxes,
            starts,
            near,
            count,
            limit,
            inverse,
            scale,
        )
        number -= count
        size = max(size // 2, BLOCK)
    return rows[crowding >= 0]
