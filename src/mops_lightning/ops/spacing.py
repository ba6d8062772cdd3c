"""Subsets with a smallest distance, chosen by priorities that depend on the coordinates only.

Points are visited in the order of a hash of their coordinates. A point is kept if no kept point is
nearer than the spacing. Therefore no two kept points are nearer, every other point has a kept one
that is nearer, and neither the order of the points nor the parts in which they are read matter.
"""

import numpy as np
from numpy.typing import NDArray

from mops_lightning.ops import cell_kernels
from mops_lightning.ops.cell_kernels import KEPT, UNSEEN
from mops_lightning.ops.voxels import group

FINEST = 2.0**30
"""Most cells along an axis."""

SMALLEST = 5e-324
LARGEST = float(np.finfo(np.float64).max)
"""Range of squared spacings: equal points are always near, and finite ones can be."""


def keep_spaced(
    points: NDArray[np.float64],
    spacing: float,
    seed: int = 0,
    weight: NDArray[np.float64] | None = None,
) -> NDArray[np.int64]:
    """Choose points of which no two are nearer than a distance, and that are near to all others.

    Args:
        points: ``(N, C)`` finite, C ≥ 1.
        spacing: the distance, above 0, in the unit of the points.
        seed: of the order in which points are visited.
        weight: ``(N,)``; heavier points are visited first. None: all are equal.

    Returns:
        Rows of ``points``, ascending; of equal points the first row.
    """
    hashes = priorities(points, seed)
    order = priority_order(points, hashes, weight)
    states = _states(points, spacing, order)
    return np.flatnonzero(states == KEPT)


def uncovered(
    points: NDArray[np.float64], kept: NDArray[np.float64], spacing: float
) -> NDArray[np.int64]:
    """Return the rows of points ``(N, C)`` to which no point of a kept set is near.

    Args:
        points: ``(N, C)``.
        kept: ``(K, C)``, no two of which are nearer than the spacing.
        spacing: as for ``keep_spaced``.
    """
    if not len(points):
        return np.empty(0, np.int64)
    low = points.min(0) - spacing
    high = points.max(0) + spacing
    is_near = ((kept >= low) & (kept <= high)).all(axis=1)
    near = kept[is_near]
    both = np.concatenate([near, points])
    states = _states(both, spacing, np.arange(len(near)))
    states_of_points = states[len(near) :]
    return np.flatnonzero(states_of_points == UNSEEN)


def priorities(points: NDArray[np.float64], seed: int = 0) -> NDArray[np.uint64]:
    """Hash the coordinates ``(N, C)`` of every point; points with lower hashes come first."""
    numbers = np.ascontiguousarray(points, np.float64) + 0.0  # -0 becomes 0
    bits = numbers.view(np.uint64).ravel()
    channels = points.shape[1]
    hashes: NDArray[np.uint64] = cell_kernels.hashes_of(bits, channels, np.uint64(seed))
    return hashes


def priority_order(
    points: NDArray[np.float64],
    hashes: NDArray[np.uint64],
    weight: NDArray[np.float64] | None = None,
) -> NDArray[np.int64]:
    """Return the rows in the order in which they are visited.

    Heavier points come first, then lower hashes, then lower coordinates, then lower rows.
    """
    if weight is not None:
        return np.lexsort((*points.T[::-1], hashes, -weight))
    row_bits = np.uint64(len(points).bit_length())
    # One sort of numbers is faster than a sort of rows: the high bits of a hash, and the row.
    rows = np.arange(len(points), dtype=np.uint64)
    words = np.sort((hashes >> row_bits << row_bits) | rows)
    row_mask = (np.uint64(1) << row_bits) - np.uint64(1)
    order = (words & row_mask).astype(np.int64)
    flat = np.ascontiguousarray(points, np.float64).ravel()
    cell_kernels.sort_ties(order, hashes, row_bits, flat, points.shape[1])
    return order


def _states(
    points: NDArray[np.float64], spacing: float, order: NDArray[np.int64]
) -> NDArray[np.uint8]:
    """Visit the points in an order, and return the state ``(N,)`` of every point."""
    if not len(points):
        return np.empty(0, np.uint8)
    missing_axes = max(3 - points.shape[1], 0)
    numbers = np.asarray(points, np.float64)
    padded = np.pad(numbers, ((0, 0), (0, missing_axes)))
    coordinates = padded[:, :3]
    shifted = coordinates - coordinates.min(0)
    largest = float(np.abs(padded).max())
    rounding = 8 * np.finfo(np.float64).eps * largest
    extent = float(shifted.max())
    side = max(spacing * (1 + 1e-6) + rounding, extent / FINEST)
    grouped = group(shifted, side)
    cell_number = len(grouped.places) // 3
    channels = padded.shape[1]
    by_cell, places, starts = cell_kernels.sort_by_cell(
        padded.ravel(), channels, grouped.cell_of, cell_number
    )
    limit = min(max(spacing * spacing, SMALLEST), LARGEST)
    states: NDArray[np.uint8] = cell_kernels.visit(
        by_cell,
        channels,
        places,
        starts,
        grouped.cell_of,
        grouped.places,
        grouped.table,
        order,
        limit,
    )
    return states
