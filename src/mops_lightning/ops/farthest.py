"""Farthest points of NumPy arrays, by the loops of ``ops.kernel_farthest``; without torch."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.ops import kernel_farthest

LEAF = 1024
"""Maximum number of points of a leaf of the tree: more leaves exclude more points, larger ones
take less time per point."""

SPARSE, SPARSE_LEAF = 100, 4096
"""Points per chosen point from which a tree with larger leaves is faster, and their size."""

THREADS_MIN_WORK = 2**22
"""Minimum number of distances in a batch, estimated, for using several threads."""

Array = NDArray[Any]
Rows = NDArray[np.int64]


def farthest_rows(
    points: Array,
    given: Rows,
    counts: Rows,
    m: int,
    factors: Array | None = None,
    ranks: Array | None = None,
    threads: int = 1,
) -> Rows | None:
    """Fill up rows of every cloud to m by the points that are farthest from the rows before.

    Args:
        points: ``(B, N, C)`` float32 or float64.
        given: ``(B, G)`` rows, G ≤ m; the first ``counts[b]`` of cloud b are the given rows.
        counts: ``(B,)``, from 1 to G.
        m: number of rows, at most N.
        factors: ``(B, N)`` float64 above 0 of the squared distances in the choice; None: 1.
        ranks: ``(B, N)`` int64: the lowest rank wins a tie, then the lowest row; None: the row.
        threads: maximum number of threads.

    Returns:
        ``(B, m)`` distinct rows; the choice is that of float64 arithmetic. None if a coordinate is
        not finite.
    """
    clouds, n, _ = points.shape
    points = np.ascontiguousarray(points)
    chosen = np.empty((clouds, m), np.int64)
    chosen[:, : given.shape[1]] = given
    reached = np.array(counts, np.int64)
    no_factors, no_ranks = np.empty((clouds, 0)), np.empty((clouds, 0), np.int64)
    arrays = (
        points,
        chosen,
        reached,
        no_factors if factors is None else np.ascontiguousarray(factors),
        no_ranks if ranks is None else np.ascontiguousarray(ranks),
    )
    workers = min(threads, clouds) if m * n * clouds >= THREADS_MIN_WORK else 1
    if workers == 1:
        finite = _fill(*arrays)
    else:
        parts = zip(*(np.array_split(array, workers) for array in arrays), strict=True)
        with ThreadPoolExecutor(workers) as pool:
            finite = all(pool.map(lambda part: _fill(*part), parts))
    if not finite:
        return None
    for cloud in np.flatnonzero(reached < m):
        order = None if ranks is None else ranks[cloud]
        _fill_with_copies(chosen[cloud], int(reached[cloud]), n, order)
    return chosen


def _fill(points: Array, chosen: Array, counts: Array, factors: Array, ranks: Array) -> bool:
    """Call the compiled loops, which write to ``chosen`` and ``counts``."""
    _, n, channels = points.shape
    leaf = SPARSE_LEAF if n > SPARSE * chosen.shape[1] else LEAF
    finite: bool = kernel_farthest.farthest(
        points.reshape(-1),
        chosen.reshape(-1),
        counts,
        factors.reshape(-1),
        ranks.reshape(-1),
        channels,
        leaf,
    )
    return finite


def _fill_with_copies(chosen: Array, reached: int, n: int, ranks: Array | None) -> None:
    """Fill up with points whose distance is 0, in the order in which they win a tie."""
    left = np.ones(n, np.bool_)
    left[chosen[:reached]] = False
    copies = np.flatnonzero(left)
    if ranks is not None:
        copies = copies[np.argsort(ranks[copies], kind="stable")]
    chosen[reached:] = copies[: len(chosen) - reached]


def float_points(points: Array) -> Array:
    """Return coordinates as float32 or float64, whichever holds their numbers exactly."""
    native = points.astype(points.dtype.newbyteorder("="), copy=False)
    if native.dtype in (np.float32, np.float64):
        return native
    return native.astype(np.float32 if native.dtype == np.float16 else np.float64)
