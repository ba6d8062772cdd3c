"""Faster farthest point sampling on a CPU, for small and for large clouds.

Small clouds: all pairwise distances are computed once, and a step only compares them.

Large clouds: neighbouring points form groups. If a new point is farther from a group's bounding
box than all points of the group are from the chosen points, the distances in the group do not
change. A step therefore updates only a few groups, as QuickFPS does with trees (Han et al., IEEE
TCAD 2023).
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

GROUP_SIZE = 128
"""Points in a group: smaller groups are more numerous, larger ones cost more per update."""

MARGIN = 1 - 1e-6
"""Factor that lowers bounds, because they are rounded differently from the distances."""


def sum_of_squares_(planes: Tensor) -> Tensor:
    """Sum the squares of the planes of ``(C, ...)``, in place of the first plane.

    All variants of farthest point sampling use this function: fused multiply-add rounds once
    instead of twice on some processors, and all variants must give identical distances.
    """
    total, *others = planes.unbind(0)
    total.mul_(total)
    for other in others:
        total.addcmul_(other, other)
    return total


def farthest_by_distance_table(points: Tensor, distances: Tensor, steps: int) -> Tensor:
    """Do the same as ``farthest_by_groups`` with a table of all N² pairwise distances.

    Args:
        points: ``(N, C)`` on the CPU, finite.
        distances: ``(N,)`` initial squared distances; -1 marks chosen points.
        steps: number of points to choose.

    Returns:
        ``(steps,)`` int64, the lowest row in case of ties.
    """
    planes = points.to(distances.dtype).mT.contiguous()
    table = sum_of_squares_(planes[:, :, None] - planes[:, None]).numpy()
    remaining = distances.numpy().copy()
    chosen = np.empty(steps, np.int64)
    for step in range(steps):
        row = remaining.argmax()
        chosen[step] = row
        remaining[row] = -1
        np.minimum(remaining, table[row], out=remaining)
    return torch.from_numpy(chosen)


def farthest_by_groups(points: Tensor, distances: Tensor, steps: int) -> Tensor:
    """Repeatedly choose the point with the largest distance and update the distances.

    Args:
        points: ``(N, C)`` on the CPU, finite, C up to 4.
        distances: ``(N,)`` initial squared distances, at least float32; -1 marks chosen points.
        steps: number of points to choose, at most the number of points that are not chosen.

    Returns:
        ``(steps,)`` int64, the lowest row in case of ties; identical to exhaustive search.
    """
    array = points.to(distances.dtype).numpy()
    rows, planes, remaining = _grouped(array, distances.numpy())
    low, high = planes.min(2), planes.max(2)
    best = remaining.argmax(1)
    numbers = np.arange(len(rows))
    peaks, peak_rows = remaining[numbers, best], rows[numbers, best]
    chosen = np.empty(steps, np.int64)
    for step in range(steps):
        ties = np.flatnonzero(peaks == peaks.max())
        group = ties[peak_rows[ties].argmin()]
        place = best[group]
        chosen[step] = rows[group, place]
        remaining[group, place] = -1
        new = planes[:, group, place]
        affected = _distances_to_boxes(low, high, new) * MARGIN < peaks
        affected[group] = True
        groups = np.flatnonzero(affected)
        updated = _updated(planes.take(groups, 1), new, remaining.take(groups, 0))
        remaining[groups] = updated
        places = updated.argmax(1)
        best[groups] = places
        peaks[groups] = updated[numbers[: len(groups)], places]
        peak_rows[groups] = rows[groups, places]
    return torch.from_numpy(chosen)


def _grouped(
    points: NDArray[np.floating], distances: NDArray[np.floating]
) -> tuple[NDArray[np.int64], NDArray[np.floating], NDArray[np.floating]]:
    """Group neighbouring points.

    Returns:
        Rows ``(G, GROUP_SIZE)``, coordinates ``(C, G, GROUP_SIZE)`` and distances
        ``(G, GROUP_SIZE)``.
    """
    # Rows are sorted within a group, so that the first maximum is the one with the lowest row. The
    # last group is padded with copies of its first point that count as chosen.
    n = len(points)
    rows = np.full(math.ceil(n / GROUP_SIZE) * GROUP_SIZE, n)
    rows[:n] = np.argsort(_z_order(points), kind="stable")
    rows = np.sort(rows.reshape(-1, GROUP_SIZE), axis=1)
    padded = np.minimum(rows, n - 1)
    padded = np.where(rows < n, padded, padded[:, :1])
    planes = np.ascontiguousarray(points[padded].transpose(2, 0, 1))
    return rows, planes, np.where(rows < n, distances[padded], -1).astype(points.dtype)


def _updated(
    planes: NDArray[np.floating], new: NDArray[np.floating], distances: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Return the minimum of the old distances and the distances to a new point."""
    differences = torch.from_numpy(planes).sub_(torch.from_numpy(new)[:, None, None])
    return torch.minimum(torch.from_numpy(distances), sum_of_squares_(differences)).numpy()


def _distances_to_boxes(
    low: NDArray[np.floating], high: NDArray[np.floating], point: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Return the squared distances from a point ``(C,)`` to boxes with corners ``(C, G)``."""
    with np.errstate(over="ignore"):
        outside = np.maximum(low - point[:, None], point[:, None] - high)
        np.maximum(outside, 0, out=outside)
        outside *= outside
        return outside.sum(0)


def _z_order(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the positions of points ``(N, C)`` on a Z-order curve."""
    bits = 30 // points.shape[1]
    low = points.min(0).astype(np.float64)
    with np.errstate(all="ignore"):
        scale = (2**bits - 1) / (points.max(0) - low).max()
        if not 0 < scale < np.inf:  # all points coincide, or their extent overflows
            return np.zeros(len(points), np.int64)
        cells = ((points - low) * scale).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(bits):
        for axis in range(points.shape[1]):
            code |= (cells[:, axis] >> bit & 1) << (points.shape[1] * bit + axis)
    return code
