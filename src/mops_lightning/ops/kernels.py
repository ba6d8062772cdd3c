"""A tree of boxes and nearest points in loops that numba compiles; ``ops.compiled`` calls them.

Squares are summed by fused multiply-add, which rounds once, as torch does on processors with
AVX2: the rows are identical to the torch forms' rows.

Points are sorted into a tree of boxes, and far boxes are skipped, as in QuickFPS (Han et al., IEEE
TCAD 2023). The distance to a box is never above the distance to a point in it, because both are
computed by the same operations in the same order, each of which is monotonic.

Arrays have one dimension, which halves the time of compilation, and are copied in loops, because
the assignment of a slice takes seconds to compile. Coordinates of C channels and N points are
``(C·N,)``, one channel after the other. ``kernel_farthest`` uses the tree, too.
"""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.jit import (
    jit,
    jit_cached,
    multiply_add,
)

LANES = 64
FANOUT = 8
PROBES = 8
"""Maximum number of children of a node, and sampled coordinates per child for where to split."""


@jit
def all_finite(values):
    """Return whether all values are finite."""
    wrong = 0
    for i in range(len(values)):
        wrong += values[i] - values[i] != 0  # NaN
    return wrong == 0


@jit
def write_distances(planes, size, start, stop, point, out):
    """Write the squared distances from a point to the rows from start to stop."""
    for axis in range(len(point)):
        line = planes[axis * size + start : axis * size + stop]
        at = point[axis]
        if axis == 0:
            for i in range(len(line)):
                d = line[i] - at
                out[i] = d * d
        else:
            for i in range(len(line)):
                d = line[i] - at
                out[i] = multiply_add(d, d, out[i])


@jit
def distance_to_box(boxes, node, point):
    """Return the squared distance from a point to the box of a node."""
    channels = len(point)
    lowest = 2 * channels * node
    highest = lowest + channels
    total = zero = point.dtype.type(0)
    for axis in range(channels):
        below = boxes[lowest + axis] - point[axis]
        above = point[axis] - boxes[highest + axis]
        d = max(below, above)
        d = max(d, zero)
        total = multiply_add(d, d, total)
    return total


@jit
def build_tree(planes, channels, leaf):
    """Sort points into a tree.

    Rows keep their order within a leaf, so that its first row is the lowest one.

    Args:
        planes: ``(C·N,)``, sorted in place.
        channels: C.
        leaf: maximum number of points of a leaf, unless all of them coincide.

    Returns:
        The original rows ``(N,)``, nodes ``(4·K,)`` with the first row, the end of the rows, the
        first child and the number of children (0 for a leaf), and boxes ``(2·C·K,)`` with the
        lowest and the highest coordinates.
    """
    size = len(planes) // channels
    rows = np.empty(size, np.uint32)
    for row in range(size):
        rows[row] = row
    # A node has at least two children or none, hence fewer than 2·N nodes. Unused memory of large
    # arrays is never touched.
    nodes = np.empty(8 * size, np.int64)
    boxes = np.empty(4 * channels * size, planes.dtype)
    child = np.empty(size, np.uint8)
    counts = np.empty(FANOUT, np.int64)
    places = np.empty(size, np.uint32)
    moved = np.empty(size, planes.dtype)
    moved_rows = moved.view(np.uint32)  # coordinates and rows are moved one after the other
    nodes[0] = 0
    nodes[1] = size
    node = 0
    known = 1
    while node < known:
        nodes[4 * node + 3] = 0
        start = nodes[4 * node]
        stop = nodes[4 * node + 1]
        axis = _write_box(planes, channels, start, stop, boxes, node)
        box = 2 * channels * node + axis
        low = boxes[box]
        high = boxes[box + channels]
        if stop - start > leaf and low < high:
            line = planes[axis * size + start : axis * size + stop]
            _split(line, low, high, child, counts, places)
            nodes[4 * node + 2] = known
            for k in range(FANOUT):
                if counts[k]:
                    nodes[4 * known] = start
                    start += counts[k]
                    nodes[4 * known + 1] = start
                    known += 1
            first_child = nodes[4 * node + 2]
            nodes[4 * node + 3] = known - first_child
            start = nodes[4 * node]
            for c in range(channels):
                coordinates = planes[c * size + start : c * size + stop]
                _move(coordinates, places, moved)
            _move(rows[start:stop], places, moved_rows)
        node += 1
    return rows, nodes[: 4 * known], boxes


@jit
def _write_box(planes, channels, start, stop, boxes, node):
    """Write the box of a node and return its longest axis."""
    size = len(planes) // channels
    longest = 0
    length = planes.dtype.type(0)
    lows = np.empty(LANES, planes.dtype)
    highs = np.empty(LANES, planes.dtype)
    for axis in range(channels):
        line = planes[axis * size + start : axis * size + stop]
        for lane in range(LANES):
            lows[lane] = highs[lane] = line[0]
        for begin in range(0, len(line), LANES):  # minima of separate lanes are vectorised
            part = line[begin : begin + LANES]
            for i in range(len(part)):
                lows[i] = part[i] if part[i] < lows[i] else lows[i]
                highs[i] = part[i] if part[i] > highs[i] else highs[i]
        low = lows[0]
        high = highs[0]
        for lane in range(LANES):
            low = min(low, lows[lane])
            high = max(high, highs[lane])
        box = 2 * channels * node + axis
        boxes[box] = low
        boxes[box + channels] = high
        if high - low > length:
            longest = axis
            length = high - low
    return longest


@jit
def _split(line, low, high, child, counts, places):
    """Write every point's child and its place in the order of children; count their points."""
    samples = np.empty(PROBES * FANOUT - 1, line.dtype)
    for i in range(len(samples)):
        place = (2 * i + 1) * len(line) // (2 * len(samples))
        value = line[place]
        j = i
        while j > 0 and samples[j - 1] > value:
            samples[j] = samples[j - 1]
            j -= 1
        samples[j] = value
    middle = low / 2 + high / 2
    if not low <= middle < high:
        middle = low
    for i in range(len(line)):
        child[i] = 0
    first_cut = samples[PROBES - 1]
    for k in range(FANOUT - 1):  # the first cut is below the highest coordinate
        cut = middle
        if first_cut < high:
            cut = samples[PROBES * (k + 1) - 1]
        for i in range(len(line)):
            child[i] += line[i] > cut
    for k in range(FANOUT):
        counts[k] = 0
    for i in range(len(line)):
        counts[child[i]] += 1
    following = np.empty(FANOUT, np.int64)
    following[0] = 0
    for k in range(1, FANOUT):
        following[k] = following[k - 1] + counts[k - 1]
    for i in range(len(line)):
        places[i] = following[child[i]]
        following[child[i]] += 1


@jit
def _move(line, places, moved):
    """Move values to their places."""
    for i in range(len(line)):
        moved[places[i]] = line[i]
    for i in range(len(line)):
        line[i] = moved[i]


@jit
def place_of(bits, wanted):
    """Return the first place of a value that occurs."""
    start = 0
    matches = 0
    while not matches:
        part = bits[start : start + 64]
        for i in range(len(part)):
            matches += part[i] == wanted
        if not matches:
            start += 64
    while bits[start] != wanted:
        start += 1
    return start


@jit_cached
def nearest(planes, queries, scratch, channels, leaf):
    """Find the nearest point for every query.

    Args:
        planes: ``(C·N,)`` coordinates, sorted in place.
        queries: ``(M·C,)`` coordinates, one query after the other.
        scratch: ``(N,)`` integers of the same width, overwritten.
        channels: C.
        leaf: maximum number of points of a leaf.

    Returns:
        ``(M,)`` rows, the lowest row in case of ties; none if a coordinate is not finite.
    """
    size = len(planes) // channels
    if not (all_finite(planes) and all_finite(queries)):
        return np.empty(0, np.int64)
    rows, nodes, boxes = build_tree(planes, channels, leaf)
    known = len(nodes) // 4
    nearest_rows = np.empty(len(queries) // channels, np.int64)
    distances = scratch.view(planes.dtype)
    point = np.empty(channels, planes.dtype)
    bounds = np.empty(known + FANOUT, planes.dtype)
    stack = np.empty(known + FANOUT, np.int64)
    for query in range(len(nearest_rows)):
        for axis in range(channels):
            point[axis] = queries[query * channels + axis]
        best = planes.dtype.type(np.inf)
        row = np.int64(size)
        stack[0] = 0
        bounds[0] = 0
        depth = 1
        while depth:
            depth -= 1
            node = stack[depth]
            if bounds[depth] > best:
                continue
            children = nodes[4 * node + 3]
            if children:
                bottom = depth
                first_child = nodes[4 * node + 2]
                for k in range(first_child, first_child + children):
                    bound = distance_to_box(boxes, k, point)
                    if bound <= best:  # the nearest child is visited first
                        place = depth
                        while place > bottom and bounds[place - 1] < bound:
                            bounds[place] = bounds[place - 1]
                            stack[place] = stack[place - 1]
                            place -= 1
                        bounds[place] = bound
                        stack[place] = k
                        depth += 1
            else:
                start = nodes[4 * node]
                stop = nodes[4 * node + 1]
                write_distances(planes, size, start, stop, point, distances)
                low = scratch[0]
                for i in range(stop - start):
                    low = min(low, scratch[i])
                i = place_of(scratch[: stop - start], low)
                is_nearer = distances[i] < best
                is_tied = distances[i] == best
                if is_nearer or (is_tied and rows[start + i] < row):
                    best = distances[i]
                    row = rows[start + i]
        nearest_rows[query] = row
    return nearest_rows
