"""Voxels of a given size: their points, their means, and the point nearest to each mean.

The grid starts at 0, so that clouds of one coordinate system share it. All sums are of whole
numbers. Therefore neither the order of the points nor the parts in which they are read matter.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mops_lightning.errors import UserError
from mops_lightning.ops import cell_kernels

MOST = 2**26
"""Most points of a voxel whose sums fit into integers of 64 bits."""

FARTHEST = 2.0**52
"""Most voxels between a point and the origin: beyond, voxels are smaller than rounding errors."""


class Voxels(NamedTuple):
    """Occupied voxels.

    Attributes:
        places: ``(K, 3)`` int64, the voxel's lowest corner divided by the size; ascending.
        counts: ``(K,)`` int64 number of points.
        sums: ``(K, 3)`` int64 sums of the distances from the lowest corner, in ``STEPS``.
    """

    places: NDArray[np.int64]
    counts: NDArray[np.int64]
    sums: NDArray[np.int64]

    def merge(self, other: "Voxels") -> "Voxels":
        """Join the voxels of two parts of a cloud."""
        places = np.concatenate([self.places, other.places])
        counts = np.concatenate([self.counts, other.counts])
        sums = np.concatenate([self.sums, other.sums])
        order, starts = runs(places)
        if not len(order):
            return self
        joined = Voxels(
            places[order[starts]],
            np.add.reduceat(counts[order], starts),
            np.add.reduceat(sums[order], starts),
        )
        _check_counts(joined.counts)
        return joined

    def rows_of(self, places: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the row of every one of the ``(k, 3)`` places, all of which are occupied."""
        places_of_both = np.concatenate([self.places, places])
        order, starts = runs(places_of_both)
        group = np.zeros(len(order), np.int64)
        group[starts[1:]] = 1
        rows = np.empty(len(order), np.int64)
        rows[order] = group.cumsum()
        return rows[len(self.places) :]

    def means(self, size: float) -> NDArray[np.float64]:
        """Return the means ``(K, 3)`` of the points of every voxel."""
        mean_steps = self.sums / self.counts[:, None]
        inside = mean_steps / cell_kernels.STEPS
        centres: NDArray[np.float64] = (self.places + inside) * size
        return centres


def runs(places: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort places ``(n, 3)`` in (x, y, z) order.

    Returns:
        Their order ``(n,)``, and where in it each different place starts.
    """
    order = np.lexsort(places.T[::-1])
    ordered = places[order]
    is_new = np.ones(len(order), bool)
    differs = ordered[1:] != ordered[:-1]
    is_new[1:] = differs.any(axis=1)
    return order, np.flatnonzero(is_new)


class Grouped(NamedTuple):
    """The points of a cloud in voxels, in the order in which the voxels are met.

    Attributes:
        cell_of: ``(N,)`` int32 voxel of every point.
        places: ``(3·K,)`` int64, as in ``Voxels``, one voxel after the other.
        table: for ``find_cell``.
    """

    cell_of: NDArray[np.int32]
    places: NDArray[np.int64]
    table: NDArray[np.int32]


def group(points: NDArray[np.float64], size: float) -> Grouped:
    """Put every point of a cloud into its voxel.

    Args:
        points: ``(N, 3)`` finite.
        size: side of a voxel, in the unit of the points.

    Raises:
        UserError: the size is too small for the coordinates.
    """
    largest = float(np.abs(points).max(initial=0.0))
    if largest / FARTHEST >= size:  # the product could overflow
        raise UserError(
            f"voxel: {size:g} is too small for coordinates of up to {largest:g}. Use larger voxels."
        )
    cells = cell_kernels.group(points.ravel(), float(size))
    return Grouped(*cells)


def occupied(points: NDArray[np.float64], size: float) -> Voxels:
    """Return the occupied voxels of a cloud; arguments and errors as in ``group``."""
    flat = np.ascontiguousarray(points, np.float64)
    grouped = group(flat, size)
    counts, sums = _sums(flat, size, grouped)
    places = grouped.places.reshape(-1, 3)
    order = np.lexsort(places.T[::-1])
    return Voxels(places[order], counts[order], sums[order])


def _sums(
    points: NDArray[np.float64], size: float, grouped: Grouped
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the ``(K,)`` counts and ``(K, 3)`` sums of ``Voxels``, in the order of the groups."""
    number = len(grouped.places) // 3
    flat = points.ravel()
    counts, sums = cell_kernels.add_up(flat, float(size), grouped.cell_of, number)
    _check_counts(counts)
    return counts, sums.reshape(-1, 3)


def _check_counts(counts: NDArray[np.int64]) -> None:
    most = counts.max(initial=0)
    if most > MOST:
        raise UserError(f"voxel: {most:,} points share one. Use voxels of up to {MOST:,} points.")


class Representatives(NamedTuple):
    """One point for each of K voxels; the better of two is well defined, so that parts merge.

    Attributes:
        rows: ``(K,)`` int64 rows of the points; -1 where a part of the cloud has none.
        distances: ``(K,)`` squared distances from the mean, in ``cell_kernels.STEPS``.
    """

    rows: NDArray[np.int64]
    distances: NDArray[np.float64]


def representatives(
    points: NDArray[np.float64],
    size: float,
    voxels: Voxels | None = None,
    weight: NDArray[np.float64] | None = None,
) -> Representatives:
    """Choose the point nearest to the mean of each voxel.

    In case of ties, the lowest x, then y, then z decides, and of equal points the first row.

    Args:
        points: ``(N, 3)`` finite: a cloud, or a part of it.
        size: side of a voxel, in the unit of the points.
        voxels: those of the whole cloud; None: the points are the whole cloud.
        weight: ``(N,)``; the heaviest point of a voxel is chosen, of equally heavy ones the
            nearest. None: all are equal.

    Returns:
        In the order of ``voxels``, or in the order in which the cloud meets them.
    """
    flat = np.ascontiguousarray(points, np.float64)
    grouped = group(flat, size)
    if voxels is None:
        counts, sums = _sums(flat, size, grouped)
        voxel_of_cell = np.arange(len(counts))
    else:
        counts = voxels.counts
        sums = voxels.sums
        voxel_of_cell = voxels.rows_of(grouped.places.reshape(-1, 3))
    means_of_voxels = sums / counts[:, None]
    means = means_of_voxels[voxel_of_cell]
    heaviness = np.empty(0)
    if weight is not None:
        heaviness = np.ascontiguousarray(weight, np.float64)
    found = cell_kernels.nearest(
        flat.ravel(), float(size), grouped.cell_of, means.ravel(), heaviness
    )
    rows = np.full(len(counts), -1, np.int64)
    distances = np.full(len(counts), np.inf)
    rows[voxel_of_cell], distances[voxel_of_cell] = found
    return Representatives(rows, distances)


class Sums(NamedTuple):
    """Exact sums of further columns in every voxel, in two parts of 36 bits.

    Attributes:
        high: ``(K, A)`` int64.
        low: ``(K, A)`` int64.
        wrong: ``(K, A)`` int64 number of values that are not finite.
    """

    high: NDArray[np.int64]
    low: NDArray[np.int64]
    wrong: NDArray[np.int64]

    def means(self, counts: NDArray[np.int64], scales: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the means ``(K, A)``; NaN where a value is not finite."""
        total = self.high + self.low / cell_kernels.STEPS
        means: NDArray[np.float64] = total / counts[:, None] / scales
        means[self.wrong > 0] = np.nan
        return means


def column_scales(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return powers of two ``(A,)`` that bring the numbers of columns ``(N, A)`` below 2³⁶."""
    finite = np.where(np.isfinite(values), values, 0.0)
    largest = np.abs(finite).max(axis=0, initial=0.0)
    return scales_for(largest)


def scales_for(largest: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``column_scales`` for the largest absolute values ``(A,)`` of columns."""
    exponent = np.frexp(largest)[1]
    power = np.clip(36 - exponent, -1000, 1000)
    scales: NDArray[np.float64] = np.ldexp(1.0, power)
    return scales


def sum_columns(
    points: NDArray[np.float64],
    size: float,
    voxels: Voxels,
    values: NDArray[np.float64],
    scales: NDArray[np.float64],
) -> Sums:
    """Sum further columns of points in every voxel.

    Args:
        points: ``(N, 3)`` the cloud, or a part of it.
        size: side of a voxel.
        voxels: those of the whole cloud.
        values: ``(N, A)`` the columns.
        scales: ``(A,)`` from ``column_scales`` of the whole cloud.
    """
    grouped = group(np.ascontiguousarray(points, np.float64), size)
    voxel_of_cell = voxels.rows_of(grouped.places.reshape(-1, 3))
    voxel = voxel_of_cell[grouped.cell_of]
    wrong = ~np.isfinite(values)
    scaled = np.where(wrong, 0.0, values) * scales
    high = np.trunc(scaled)
    low = np.rint((scaled - high) * cell_kernels.STEPS)
    shape = (len(voxels.counts), values.shape[1])
    sums = Sums(
        high=np.zeros(shape, np.int64),
        low=np.zeros(shape, np.int64),
        wrong=np.zeros(shape, np.int64),
    )
    np.add.at(sums.high, voxel, high.astype(np.int64))
    np.add.at(sums.low, voxel, low.astype(np.int64))
    np.add.at(sums.wrong, voxel, wrong.astype(np.int64))
    return sums


def voxel_means(points: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """Return the means ``(K, C)`` of all columns of the points ``(N, C)`` of every voxel.

    The first three columns are the coordinates. The voxels are in ascending (x, y, z) order.
    """
    coordinates = np.ascontiguousarray(points[:, :3], np.float64)
    voxels = occupied(coordinates, size)
    further = np.asarray(points[:, 3:], np.float64)
    scales = column_scales(further)
    sums = sum_columns(coordinates, size, voxels, further, scales)
    return np.concatenate([voxels.means(size), sums.means(voxels.counts, scales)], axis=1)
