"""Farthest points in loops that numba compiles; ``ops.farthest`` calls them."""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops import kernel_keys, kernels
from mops_lightning.ops.jit import (
    bits_float,
    float_bits,
    jit,
    jit_cached_with,
    jit_inlined,
    multiply_add,
)
from mops_lightning.ops.kernel_keys import ranks_of, to_planes
from mops_lightning.ops.kernels import (
    FANOUT,
    build_tree,
    distance_to_box,
    place_of,
    write_distances,
)

BLOCK = 128
"""Number of distances that are compared at a time."""

BY_ROW = 0
BY_KEYS = 1
BY_KEYS_IN_SPHERE = 2
"""What comes first and wins a tie: the lowest row, or the lowest key of the given points or of
those in the unit sphere. Copies have one key, the lowest row of them comes first."""


@jit_cached_with(kernels, kernel_keys)
def farthest(points, chosen, counts, factors, ranking, word, channels, leaf):
    """Repeatedly choose the point that is farthest from all points chosen before it.

    Distances in the type of the coordinates find the candidates of a choice. Where there are
    several, float64 distances decide, so that rounding to float32 does not change the choice.

    Args:
        points: ``(B·N·C,)`` coordinates, one point after the other.
        chosen: ``(B·M,)`` rows; the first ``counts`` of a cloud are given, the others are written.
        counts: ``(B,)`` number of given rows; at least 1 with ``BY_ROW``. The number of chosen rows
            is written: it is below M where all points that are left are copies of chosen ones.
        factors: ``(B·N,)`` float64, above 0: the point with the largest product of factor and
            squared distance is chosen; or ``(0,)``.
        ranking: ``BY_ROW``, ``BY_KEYS`` or ``BY_KEYS_IN_SPHERE``.
        word: the seed of the keys, mixed.
        channels: C.
        leaf: maximum number of points of a leaf.

    Returns:
        Whether all coordinates are finite.
    """
    clouds = len(counts)
    size = len(points) // (clouds * channels)
    steps = len(chosen) // clouds
    in_sphere = ranking == BY_KEYS_IN_SPHERE
    for cloud in range(clouds):
        start = cloud * size
        stop = start + size
        given = points[start * channels : stop * channels]
        planes, largest = to_planes(given, channels)
        if not largest < np.inf:
            return False
        ranks = np.empty(0, np.int64)
        rows = chosen[cloud * steps : (cloud + 1) * steps]
        if counts[cloud] == 0:
            ranks = ranks_of(planes, channels, largest, word, in_sphere, False)
            rows[0] = _first_of_lowest(ranks)
            counts[cloud] = 1
        weights = factors
        if len(factors):
            weights = factors[start:stop]
        counts[cloud] = _choose(
            given, planes, rows, counts[cloud], weights, ranking, word, ranks, channels, leaf
        )
    return True


@jit
def _first_of_lowest(ranks):
    lowest = ranks[0]
    for i in range(len(ranks)):
        lowest = min(lowest, ranks[i])
    return place_of(ranks, lowest)


@jit
def _ranks_of_given(points, channels, word, in_sphere):
    planes, largest = to_planes(points, channels)
    return ranks_of(planes, channels, largest, word, in_sphere, False)


@jit_inlined
def _choose(points, planes, chosen, given, factors, ranking, word, ranks, channels, leaf):
    """Choose farthest points of one cloud; arguments as for ``farthest``.

    Keys are computed at the first tie, unless the first point needed them: ``ranks`` is ``(0,)``.
    """
    size = len(planes) // channels
    steps = len(chosen)
    rows, nodes, boxes = build_tree(planes, channels, leaf)
    known = len(nodes) // 4
    factors = _sorted(factors, rows)
    # The bits of floats ≥ 0, read as integers, have the same order, and numba vectorises the
    # maximum of integers only. Chosen points have the distance -1, a negative integer.
    infinity = planes.dtype.type(np.inf)
    bits = np.full(size, float_bits(infinity))
    gaps = bits.view(planes.dtype)
    # The largest distance of every node and, with factors, the largest product.
    tops = np.full(known, bits[0])
    gain_nodes = 0
    if len(factors):
        gain_nodes = known
    gains = np.full(gain_nodes, np.inf)
    # Float64 coordinates of the chosen points; float64 distances, and to how many of them.
    path = np.empty(channels * steps)
    exact = np.empty(size)
    seen = np.zeros(size, np.int32)
    found = np.empty(size, np.uint32)
    stack = np.empty(known + FANOUT, np.int64)
    new = np.empty(min(leaf, size), planes.dtype)
    point = np.empty(channels, planes.dtype)
    places = rows
    if given > 1:
        places = _inverse(rows)
    for step in range(steps):
        place = np.int64(0)
        if step < given:
            if given > 1:
                place = np.int64(places[chosen[step]])
            else:
                place = place_of(rows, chosen[step])
        else:
            count = _candidates(nodes, tops, bits, gains, factors, gaps, channels, stack, found)
            place = np.int64(found[0])
            best = -1.0
            if count == 1:
                count = 0
            for k in range(count):
                i = found[k]
                low = _least_square(path, seen[i], step, steps, planes, i)
                if seen[i]:
                    low = min(exact[i], low)
                exact[i] = low
                seen[i] = step
                gain = low
                if len(factors):
                    gain = low * factors[i]
                if gain == best and ranking != BY_ROW and len(ranks) == 0:
                    ranks = _ranks_of_given(points, channels, word, ranking == BY_KEYS_IN_SPHERE)
                is_tied = gain == best
                if gain > best or (is_tied and _precedes(rows, ranks, i, place)):
                    best = gain
                    place = np.int64(i)
            if best == 0:
                return step
            chosen[step] = rows[place]
        gaps[place] = -1
        for axis in range(channels):
            point[axis] = planes[axis * size + place]
            path[axis * steps + step] = point[axis]
        _update(planes, nodes, boxes, place, point, bits, tops, gains, factors, gaps, stack, new)
    return np.int64(steps)


@jit
def _sorted(factors, rows):
    """Return the factors in the order of the tree."""
    moved = np.empty(len(factors))
    for place in range(len(factors)):
        moved[place] = factors[rows[place]]
    return moved


@jit
def _inverse(rows):
    """Return the place of every row."""
    places = np.empty_like(rows)
    for place in range(len(rows)):
        places[rows[place]] = place
    return places


@jit
def _precedes(rows, ranks, place, other):
    """Return whether a point is chosen before another one at the same distance."""
    row = rows[place]
    other_row = rows[other]
    if len(ranks) and ranks[row] != ranks[other_row]:
        return ranks[row] < ranks[other_row]
    return row < other_row


@jit
def _least_square(path, start, stop, steps, planes, place):
    """Return a point's least squared distance to chosen points, computed in float64."""
    size = len(planes) * steps // len(path)
    channels = len(path) // steps
    bits = np.full(stop - start, float_bits(0.0))
    squares = bits.view(path.dtype)
    for axis in range(channels):
        at = np.float64(planes[axis * size + place])
        line = path[axis * steps + start : axis * steps + stop]
        for i in range(len(squares)):
            d = line[i] - at
            squares[i] += d * d  # rounded twice, as in NumPy
    least = bits[0]
    for i in range(len(bits)):
        least = min(least, bits[i])
    return bits_float(least, 0.0)


@jit
def _candidates(nodes, tops, bits, gains, factors, gaps, channels, stack, found):
    """Find the places of all points that could be the farthest; return their number."""
    limits = np.finfo(gaps.dtype)
    share = 1 - 2 * (channels + 2) * np.float64(limits.eps)  # twice the largest rounding error
    top = np.float64(bits_float(tops[0], gaps[0]))
    if len(gains):
        top = gains[0]
    top = min(top, np.float64(limits.max))
    least = max(top * share - channels * limits.tiny, 0.0)
    wanted = float_bits(gaps.dtype.type(least))
    stack[0] = 0
    depth = 1
    count = 0
    while depth:
        depth -= 1
        node = stack[depth]
        is_below = tops[node] < wanted
        if len(gains):
            is_below = gains[node] < least
        if is_below:
            continue
        first = nodes[4 * node + 2]
        children = nodes[4 * node + 3]
        for k in range(first, first + children):
            stack[depth] = k
            depth += 1
        if children:
            continue
        start = nodes[4 * node]
        stop = nodes[4 * node + 1]
        if len(gains):
            for i in range(start, stop):
                is_free = gaps[i] >= 0
                if is_free and gaps[i] * factors[i] >= least:
                    found[count] = i
                    count += 1
            continue
        for begin in range(start, stop, BLOCK):
            part = bits[begin : min(begin + BLOCK, stop)]
            low = bits[begin]
            for i in range(len(part)):
                low = part[i] if part[i] > low else low
            if low < wanted:
                continue
            for i in range(len(part)):
                if part[i] >= wanted:
                    found[count] = begin + i
                    count += 1
    return count


@jit
def _update(planes, nodes, boxes, place, point, bits, tops, gains, factors, gaps, stack, new):
    """Lower the distances of all points to those from a chosen point."""
    size = len(bits)
    stack[0] = 0
    depth = 1
    while depth:
        depth -= 1
        node = stack[depth]
        above = node < 0  # all children are up to date
        if above:
            node = ~node
        children = nodes[4 * node + 3]
        first = nodes[4 * node + 2]
        stop = first + children
        if above:
            tops[node] = tops[first]
            for k in range(first + 1, stop):
                tops[node] = max(tops[node], tops[k])
            if len(gains):
                gains[node] = gains[first]
                for k in range(first + 1, stop):
                    gains[node] = max(gains[node], gains[k])
        elif children:
            stack[depth] = ~node
            depth += 1
            for k in range(first, stop):
                nearest = float_bits(distance_to_box(boxes, k, point))
                if nearest < tops[k] or nodes[4 * k] <= place < nodes[4 * k + 1]:
                    stack[depth] = k
                    depth += 1
        else:
            start = nodes[4 * node]
            stop = nodes[4 * node + 1]
            distances = bits[start:stop]
            tops[node] = _lower(planes, size, start, stop, point, distances, new)
            if len(gains):
                gains[node] = -1
                for i in range(start, stop):
                    gain = gaps[i] * factors[i]
                    gains[node] = max(gains[node], gain)


@jit
def _lower(planes, size, start, stop, point, bits, new):
    """Lower distances to those from a point and return the largest."""
    top = float_bits(point.dtype.type(-1))
    if len(point) == 3:
        px = point[0]
        py = point[1]
        pz = point[2]
        x = planes[start:stop]
        y = planes[size + start : size + stop]
        z = planes[2 * size + start : 2 * size + stop]
        for i in range(len(bits)):
            dx = x[i] - px
            dy = y[i] - py
            dz = z[i] - pz
            in_plane = multiply_add(dy, dy, dx * dx)
            low = float_bits(multiply_add(dz, dz, in_plane))
            low = low if low < bits[i] else bits[i]
            bits[i] = low
            top = top if top > low else low
        return top
    write_distances(planes, size, start, stop, point, new)
    for i in range(len(bits)):
        low = float_bits(new[i])
        bits[i] = min(bits[i], low)
        top = max(top, bits[i])
    return top
