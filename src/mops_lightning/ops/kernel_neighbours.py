"""Nearest rows and rows of largest features, in loops that numba compiles for ``ops.compiled``."""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops import kernel_keys, kernels
from mops_lightning.ops.jit import (
    float_bits,
    jit,
    jit_cached,
    jit_cached_with,
    jit_inlined,
    multiply_add,
)
from mops_lightning.ops.kernel_keys import to_planes
from mops_lightning.ops.kernels import write_distances

MOST_TIED = 8
"""Candidates per neighbour from which a list is sorted point by point, as in clouds of copies."""


@jit_cached_with(kernels, kernel_keys)
def neighbours(points, queries, clouds, channels, out):
    """Write the rows of the k nearest points of every query, nearest first.

    Distances are halved by minima of pairs until about 3·k minima are left. The k-th smallest of
    these is at least the distance of the k-th neighbour. The points that are as near are found by
    descending from the minima, and sorted. Comparisons are those of integers, which are vectorised:
    floats that are not negative are ordered as their bits.

    Args:
        points: ``(B·N·C,)`` coordinates, one point after the other.
        queries: ``(B·M·C,)`` likewise.
        clouds: B.
        channels: C.
        out: ``(B·M, k)`` rows, of ties the lowest ones.

    Returns:
        Whether all coordinates are finite.
    """
    size = len(points) // (clouds * channels)
    number, k = len(out) // clouds, out.shape[1]
    starts, sizes = _levels(size, k)
    values = np.full(starts[-1] + sizes[-1], float_bits(points.dtype.type(0)))
    distances = values[:size].view(points.dtype)
    tops = values[starts[-1] :]
    ranks = np.empty(max(len(tops), MOST_TIED * k), np.int32)
    rows, others = np.empty(size + 2, np.int64), np.empty(size + 2, np.int64)
    near = np.empty(MOST_TIED * k, values.dtype)
    point = np.empty(channels, points.dtype)
    for cloud in range(clouds):
        planes, largest = to_planes(
            points[cloud * size * channels : (cloud + 1) * size * channels], channels
        )
        if not largest < np.inf:
            return False
        for query in range(cloud * number, (cloud + 1) * number):
            is_finite = True
            for axis in range(channels):
                point[axis] = queries[query * channels + axis]
                is_finite &= abs(point[axis]) < np.inf
            if not is_finite:
                return False
            _write_squares(planes, point, distances)
            _write_minima(values, starts, sizes)
            limit = _k_th(tops, k, ranks)
            count = _descend(values, starts, sizes, limit, rows, others)
            if count > MOST_TIED * k:
                _write_first(values, size, limit, near[:k], out[query])
            else:
                _write_sorted(values, rows, count, near, ranks, out[query])
    return True


@jit
def _levels(size, k):
    """Return where every level of minima starts, and its size; the first has the distances."""
    sizes = np.empty(64, np.int64)
    starts = np.zeros(64, np.int64)
    sizes[0], level = size, 0
    while sizes[level] >= 4 * k:
        starts[level + 1] = starts[level] + sizes[level]
        sizes[level + 1] = (sizes[level] + 1) // 2
        level += 1
    return starts[: level + 1], sizes[: level + 1]


@jit_inlined
def _write_squares(planes, point, squares):
    """Write the squared distances of all points from a point."""
    size = len(squares)
    if len(point) != 3:
        write_distances(planes, size, 0, size, point, squares)
        return
    x, y, z = planes[:size], planes[size : 2 * size], planes[2 * size : 3 * size]
    px, py, pz = point[0], point[1], point[2]
    for i in range(size):  # one loop is faster than one for each axis
        dx, dy, dz = x[i] - px, y[i] - py, z[i] - pz
        squares[i] = multiply_add(dz, dz, multiply_add(dy, dy, dx * dx))


@jit_inlined
def _write_minima(values, starts, sizes):
    """Write the minima of pairs: value j and value j + half of the level before."""
    for level in range(1, len(sizes)):
        start, half, below = starts[level - 1], sizes[level], sizes[level - 1]
        left, right = values[start : start + half], values[start + half : start + below]
        out = values[starts[level] : starts[level] + half]
        for j in range(len(right)):
            out[j] = min(left[j], right[j])
        if below % 2:
            out[half - 1] = left[half - 1]


@jit_inlined
def _k_th(values, k, ranks):
    """Return the k-th smallest value."""
    for i in range(len(values)):
        ranks[i] = 0
    for j in range(len(values)):
        value = values[j]
        for i in range(len(values)):
            ranks[i] += np.int32(value < values[i])
    top = values.dtype.type(0)
    for i in range(len(values)):
        value = values[i] if ranks[i] < k else values.dtype.type(0)
        top = max(top, value)
    return top


@jit_inlined
def _descend(values, starts, sizes, limit, rows, others):
    """Write the rows of the distances up to a limit, and return their number."""
    last, count = len(sizes) - 1, 0
    for j in range(sizes[last]):
        rows[count] = j
        count += values[starts[last] + j] <= limit
    for level in range(last - 1, -1, -1):
        start, size, half = starts[level], sizes[level], sizes[level + 1]
        found = 0
        for i in range(count):
            right = rows[i] + half
            others[found] = right
            found += right < size and values[start + right] <= limit
        kept = 0
        for i in range(count):
            row = rows[i]
            rows[kept] = row
            kept += values[start + row] <= limit
        for i in range(found):
            rows[kept + i] = others[i]
        count = kept + found
    return count


@jit_inlined
def _write_sorted(values, rows, count, near, places, out):
    """Write the rows of the smallest values, of ties the lowest ones."""
    for i in range(count):
        near[i] = values[rows[i]]
        places[i] = 0
    for j in range(count):
        value, row = near[j], rows[j]
        for i in range(count):
            is_before = (value < near[i]) | ((value == near[i]) & (row < rows[i]))
            places[i] += np.int32(is_before)
    for i in range(count):
        if places[i] < len(out):
            out[places[i]] = rows[i]


@jit
def _write_first(values, size, limit, best, out):
    """Write the rows of the smallest values up to a limit that many values reach."""
    k, known = len(out), 0
    for row in range(size):
        value = values[row]
        if value > limit or (known == k and value >= best[k - 1]):
            continue
        known = min(known + 1, k)
        place = known - 1
        while place > 0 and best[place - 1] > value:
            best[place] = best[place - 1]
            out[place] = out[place - 1]
            place -= 1
        best[place] = value
        out[place] = row


@jit_cached
def winners(features, rows, out):
    """Write for every line of rows the row with the largest feature in each channel.

    Args:
        features: ``(B, N, C)``.
        rows: ``(B, M, k)`` int64.
        out: ``(B, M, C)`` int64.
    """
    clouds, number, channels = out.shape
    best = np.empty(channels, features.dtype)
    winner = np.empty(channels, np.int32)  # narrow, which is faster
    for cloud in range(clouds):
        for i in range(number):
            line = features[cloud, rows[cloud, i, 0]]
            for c in range(channels):
                best[c] = line[c]
                winner[c] = 0
            for j in range(1, rows.shape[2]):
                line = features[cloud, rows[cloud, i, j]]
                for c in range(channels):
                    larger = line[c] > best[c] or line[c] != line[c]  # NaN is passed on
                    best[c] = line[c] if larger else best[c]
                    winner[c] = j if larger else winner[c]
            for c in range(channels):
                out[cloud, i, c] = rows[cloud, i, winner[c]]
