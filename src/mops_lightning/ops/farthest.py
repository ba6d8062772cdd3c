"""Farthest points of NumPy arrays, by the loops of ``ops.kernel_farthest``; without torch."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mops_lightning.ops import kernel_farthest
from mops_lightning.ops.keys import SeededOrder, point_hashes, seed_word, unit_spheres

LEAF = 1024
"""Maximum number of points of a leaf of the tree: more leaves exclude more points, larger ones
take less time per point."""

SPARSE = 100
SPARSE_LEAF = 4096
"""Points per chosen point from which a tree with larger leaves is faster, and their size."""

THREADS_MIN_WORK = 2**22
"""Minimum number of distances in a batch, estimated, for using several threads."""

LEAST_FACTOR = 1e-200
"""Least squared weight: products of a chosen point, whose distance is -1, must be below 0."""

FARTHEST: Final = "farthest"
"""Start at the point farthest from the mean."""

Array = NDArray[Any]
Rows = NDArray[np.int64]


def farthest_rows(
    points: Array,
    given: Rows,
    counts: Rows,
    m: int,
    factors: Array | None = None,
    order: SeededOrder | None = None,
    threads: int = 1,
) -> Rows | None:
    """Fill up rows of every cloud to m by the points that are farthest from the rows before.

    Args:
        points: ``(B, N, C)`` float32 or float64.
        given: ``(B, G)`` rows, G ≤ m; the first ``counts[b]`` of cloud b are the given rows.
        counts: ``(B,)``, from 0 to G. Without given rows, the first row is that of the order.
        m: number of rows, at most N.
        factors: ``(B, N)`` float64 above 0 of the squared distances in the choice; None: 1.
        order: which point comes first, and is chosen in case of ties; None: the lowest row. Keys
            are computed at the first tie.
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
    if factors is None:
        factors = np.empty((clouds, 0))
    factors = np.ascontiguousarray(factors)
    workers = 1
    if m * n * clouds >= THREADS_MIN_WORK:
        workers = min(threads, clouds)
    if workers == 1:
        finite = _fill(points, chosen, reached, factors, order)
    else:
        parts = np.array_split(np.arange(clouds), workers)
        slices = [slice(part[0], part[-1] + 1) for part in parts]

        def fill(part: slice) -> bool:
            return _fill(points[part], chosen[part], reached[part], factors[part], order)

        with ThreadPoolExecutor(workers) as pool:
            finite = all(pool.map(fill, slices))
    if not finite:
        return None
    for cloud in np.flatnonzero(reached < m):
        points_of_cloud = points[cloud : cloud + 1]
        _fill_with_copies(chosen[cloud], int(reached[cloud]), points_of_cloud, order)
    return chosen


def rows_from_start(
    points: Array,
    m: int,
    order: SeededOrder,
    start: int | str | None = None,
    weight: Array | None = None,
    threads: int = 1,
) -> Rows | None:
    """Return rows ``(B, m)`` of farthest points in the order of choice.

    Args:
        points: ``(B, N, C)`` float32 or float64.
        m: number of rows, at most N.
        order: breaks ties and, without ``start``, determines the first point.
        start: the first point of every cloud: a row, ``FARTHEST`` for the point farthest from the
            mean, or None for that of the order, with weights for the heaviest point.
        weight: ``(B, N)`` finite and above 0: factors of the distances.
        threads: maximum number of threads.

    Returns:
        ``(B, m)`` distinct rows, or None if a coordinate is not finite.
    """
    clouds = len(points)
    if start is None and weight is None:
        given = np.empty((clouds, 0), np.int64)
    elif isinstance(start, int):
        given = np.full((clouds, 1), start)
    elif start == FARTHEST:
        if not np.isfinite(points).all():
            return None
        given = _first_of_largest(_squares_from_mean(points), points, order)
    else:
        assert weight is not None
        given = _first_of_largest(weight, points, order)
    counts = np.full(clouds, given.shape[1])
    factors = None
    if weight is not None:
        factors = squared_factors(weight)
    return farthest_rows(points, given, counts, m, factors, order, threads)


def squared_factors(weight: Array) -> NDArray[np.float64]:
    """Return the factors ``(B, N)`` of squared distances for weights of distances."""
    exact = weight.astype(np.float64)
    relative = exact / weight.max(1, keepdims=True)
    squared = np.square(relative)
    factors: NDArray[np.float64] = np.maximum(squared, LEAST_FACTOR)
    return factors


def _squares_from_mean(points: Array) -> NDArray[np.float64]:
    """Return the squared distances ``(B, N)`` of points from their cloud's mean."""
    centres = unit_spheres(points)[:, None, :-1]
    squares = np.zeros(points.shape[:2])
    with np.errstate(over="ignore"):  # infinite squares are largest, too
        for axis in range(points.shape[2]):
            apart = points[..., axis] - centres[..., axis]
            squares += np.square(apart)
    return squares


def _first_of_largest(values: Array, points: Array, order: SeededOrder) -> Rows:
    """Return the rows ``(B, 1)`` of the largest values; the lowest hash, then row wins a tie."""
    is_largest = values == values.max(1, keepdims=True)
    if (is_largest.sum(1) == 1).all():
        return is_largest.argmax(1)[:, None]
    hashes = point_hashes(points, order)
    last = np.iinfo(hashes.dtype).max
    rows = np.where(is_largest, hashes, last).argmin(1)
    return rows[:, None]


def _fill(
    points: Array,
    chosen: Array,
    counts: Array,
    factors: Array,
    order: SeededOrder | None,
) -> bool:
    """Call the compiled loops, which write to ``chosen`` and ``counts``."""
    _, n, channels = points.shape
    leaf = LEAF
    if n > SPARSE * chosen.shape[1]:
        leaf = SPARSE_LEAF
    ranking = kernel_farthest.BY_ROW
    word = seed_word(0)
    if order is not None:
        ranking = kernel_farthest.BY_KEYS
        if order.in_sphere:
            ranking = kernel_farthest.BY_KEYS_IN_SPHERE
        word = seed_word(order.seed)
    finite: bool = kernel_farthest.farthest(
        points.reshape(-1),
        chosen.reshape(-1),
        counts,
        factors.reshape(-1),
        ranking,
        word,
        channels,
        leaf,
    )
    return finite


def _fill_with_copies(chosen: Array, reached: int, cloud: Array, order: SeededOrder | None) -> None:
    """Fill up with points whose distance is 0, in the order in which they win a tie.

    Args:
        chosen: ``(m,)`` rows.
        reached: number of rows that are chosen.
        cloud: ``(1, N, C)``.
        order: see ``farthest_rows``.
    """
    left = np.ones(cloud.shape[1], np.bool_)
    left[chosen[:reached]] = False
    copies = np.flatnonzero(left)
    if order is not None:
        hashes = point_hashes(cloud, order)[0]
        copies = copies[np.argsort(hashes[copies], kind="stable")]
    number = len(chosen) - reached
    chosen[reached:] = copies[:number]


def float_points(points: Array) -> Array:
    """Return coordinates as float32 or float64, whichever holds their numbers exactly."""
    native = points.astype(points.dtype.newbyteorder("="), copy=False)
    if native.dtype in (np.float32, np.float64):
        return native
    if native.dtype == np.float16:
        return native.astype(np.float32)
    return native.astype(np.float64)
