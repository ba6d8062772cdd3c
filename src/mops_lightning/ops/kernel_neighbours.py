"""Nearest rows and rows of largest features, in loops that numba compiles for ``ops.compiled``."""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.jit import jit, jit_cached, multiply_add


@jit
def insert(best, rows, value, row):
    """Put a value into an ascending list, and its row beside it; the largest value is dropped."""
    place = len(best) - 1
    while place > 0 and best[place - 1] > value:
        best[place] = best[place - 1]
        rows[place] = rows[place - 1]
        place -= 1
    best[place] = value
    rows[place] = row


@jit_cached
def neighbours(planes, queries, best, scratch, channels):
    """Return the rows of the k = len(best) nearest points of every query, nearest first.

    Planes are one channel of all points after the other, queries one point after the other.
    ``best`` contains k times the largest of the integers as wide as a coordinate, ``scratch`` is
    one such integer per point: floats that are not negative are ordered as these, and comparing
    integers is vectorised.
    """
    n, k, largest = len(scratch), len(best), best[0]
    distances = scratch.view(planes.dtype)
    minima = np.empty(min(4 * k, n), scratch.dtype)
    candidates = np.empty(n + 1, np.int64)
    out = np.empty((len(queries) // channels, k), np.int64)
    for i in range(len(out)):
        distances[:] = 0
        for c in range(channels):
            value = queries[i * channels + c]
            plane = planes[c * n : (c + 1) * n]
            for j in range(n):
                difference = plane[j] - value
                distances[j] = multiply_add(difference, difference, distances[j])
        # At least k points are as near as the k-th of the minima over every 4k-th point.
        minima[:] = scratch[: len(minima)]
        for start in range(len(minima), n, len(minima)):
            part = scratch[start : start + len(minima)]
            for j in range(len(part)):
                minima[j] = part[j] if part[j] < minima[j] else minima[j]
        best[:] = largest
        for j in range(len(minima)):
            if minima[j] < best[-1]:
                insert(best, out[i], minima[j], j)
        limit = best[-1]
        count = 0
        for j in range(n):
            candidates[count] = j
            count += scratch[j] <= limit
        best[:] = largest
        for j in candidates[:count]:
            if scratch[j] < best[-1]:
                insert(best, out[i], scratch[j], j)
    return out


@jit_cached
def winners(features, rows):
    """Return for every line of rows the row with the largest feature in each channel."""
    channels = features.shape[1]
    out = np.empty((len(rows), channels), np.int64)
    best = np.empty(channels, features.dtype)
    winner = np.empty(channels, np.int32)  # narrow, which is faster
    for i in range(len(rows)):
        best[:] = features[rows[i, 0]]
        winner[:] = 0
        for j in range(1, rows.shape[1]):
            line = features[rows[i, j]]
            for c in range(channels):
                larger = line[c] > best[c] or line[c] != line[c]  # NaN is passed on
                best[c] = line[c] if larger else best[c]
                winner[c] = j if larger else winner[c]
        for c in range(channels):
            out[i, c] = rows[i, winner[c]]
    return out
