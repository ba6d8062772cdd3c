"""The rows of the largest features, in a loop that numba compiles; ``ops.compiled`` calls it."""

# mypy: disable-error-code="no-untyped-def"

import numpy as np

from mops_lightning.ops.jit import jit_cached


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
