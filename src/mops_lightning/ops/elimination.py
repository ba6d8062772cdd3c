"""Sample elimination: remove the most crowded point of a cloud until m points remain.

Yuksel, "Sample Elimination for Generating Poisson Disk Sample Sets", Computer Graphics Forum 2015.
Numba compiles the loops, which visit the points of neighbouring cells only. They run on the CPU,
for clouds on other devices, too.
"""

# mypy: disable-error-code="no-untyped-def"

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.kernels import jit, jit_cached
from mops_lightning.ops.points import gather_points

FINEST = 2**20
"""Maximum number of cells along an axis: three positions fit into an integer of 64 bits."""

Places = NDArray[np.int64]


@torch.no_grad()
def eliminate(points: Tensor, m: int) -> Tensor:
    """Remove the most crowded point of every cloud until m remain; see ``PoissonSampler``.

    Args:
        points: ``(B, N, 3)``, finite; the first point is removed in case of ties.
        m: number of points that remain, 1 ≤ m ≤ N.

    Returns:
        ``(B, m)`` int64 rows of ``points``, ascending.
    """
    number = points.shape[1]
    points = points.double()
    reach = spacing_bound(points, m).clamp_min(torch.finfo(points.dtype).tiny)
    # Sums of integers do not depend on the order of the points.
    scale = 2.0 ** min(50, 62 - number.bit_length())
    clouds = zip(points.cpu().numpy(), reach.flatten().tolist(), strict=True)
    rows = [_eliminate_by_cells(cloud, m, bound, scale) for cloud, bound in clouds]
    return torch.stack(rows).to(points.device)


def spacing_bound(points: Tensor, m: int) -> Tensor:
    """Return an upper bound of the smallest distance among any m points of a cloud.

    Every point is within half of this bound of one of the first m − 1 points of farthest point
    sampling. Of any m points, two therefore share the same one.

    Args:
        points: ``(B, N, C)``.
        m: number of points.

    Returns:
        ``(B, 1)``.
    """
    if m == 1:
        spans = points.amax(1) - points.amin(1)
        return torch.linalg.vector_norm(spans, dim=1, keepdim=True)
    chosen = gather_points(points, farthest_point_sample(points, m))
    last = torch.linalg.vector_norm(chosen[:, :-1] - chosen[:, -1:], dim=2)
    return 2 * last.amin(1, keepdim=True)


def _eliminate_by_cells(points: NDArray[np.float64], m: int, reach: float, scale: float) -> Tensor:
    """Return the rows ``(m,)`` that remain of ``(N, 3)`` points, by the compiled loops."""
    low = points.min(0)
    extent = float((points.max(0) - low).max())
    side = max(reach, extent / FINEST) * (1 + 1e-9)
    position = ((points - low) / side).astype(np.int64) + 1  # so that no neighbour is below 0
    key = (position[:, 0] * 2 * FINEST + position[:, 1]) * 2 * FINEST + position[:, 2]
    order = key.argsort(kind="stable")
    cells, starts, cell_of, numbers = np.unique(
        key[order], return_index=True, return_inverse=True, return_counts=True
    )
    planes = np.ascontiguousarray(points[order].T)
    around = _around(cells)
    remains = _remove_crowded(planes, order, starts, numbers, cell_of, around, m, reach, scale)
    return torch.from_numpy(np.flatnonzero(remains))


def _around(cells: Places) -> NDArray[np.int32]:
    """Return each cell and its neighbours as places in ``cells``, ``(K, 27)``; -1 for none."""
    around = np.empty((len(cells), 27), np.int32)
    for column, (x, y, z) in enumerate(itertools.product((-1, 0, 1), repeat=3)):
        wanted = cells + ((x * 2 * FINEST + y) * 2 * FINEST + z)
        place = np.minimum(np.searchsorted(cells, wanted), len(cells) - 1)
        around[:, column] = np.where(cells[place] == wanted, place, -1)
    return around


@jit
def _change(planes, starts, numbers, near, sign, reach, scale, x, y, z, crowding):
    """Add weights to the crowding of all points around a place, and return their sum."""
    limit = reach * reach * (1 + 1e-12) + 2.3e-308  # weights beyond are 0, whatever the rounding
    total = np.int64(0)
    for k in range(len(near)):
        cell = near[k]
        if cell >= 0:
            for i in range(starts[cell], starts[cell] + numbers[cell]):
                dx, dy, dz = planes[0, i] - x, planes[1, i] - y, planes[2, i] - z
                squared = dx * dx + dy * dy + dz * dz
                if squared <= limit:
                    share = max(1.0 - np.sqrt(squared) / reach, 0.0)
                    share *= share
                    share *= share
                    weight = np.int64(share * share * scale)
                    crowding[i] += sign * weight
                    total += weight
    return total


@jit
def _sink(heap, keys, order, top):
    """Restore the order of a heap below an entry whose key has become smaller."""
    place = heap[top]
    while True:
        child = 2 * top + 1
        if child >= len(heap):
            break
        other = child + 1
        if other < len(heap) and _before(keys, order, heap[other], heap[child]):
            child = other
        if not _before(keys, order, heap[child], place):
            break
        heap[top] = heap[child]
        top = child
    heap[top] = place


@jit
def _before(keys, order, point, other):
    return keys[point] > keys[other] or (keys[point] == keys[other] and order[point] < order[other])


@jit_cached
def _remove_crowded(planes, order, starts, numbers, cell_of, around, m, reach, scale):
    """Remove the most crowded point until m remain.

    Args:
        planes: ``(3, N)`` coordinates of points that are sorted by their cell; changed.
        order: ``(N,)`` their rows; the lowest row is removed in case of ties.
        starts: ``(K,)`` first point of every cell.
        numbers: ``(K,)`` number of points of every cell; changed.
        cell_of: ``(N,)`` cell of every point.
        around: ``(K, 27)`` cells with all points nearer than ``reach``; -1 for none.
        m: number of points that remain.
        reach: distance from which weights are 0, positive.
        scale: factor of the weights before they are truncated to integers.

    Returns:
        ``(N,)`` whether each row remains.
    """
    size = len(order)
    crowding, keys, nothing = np.zeros(size, np.int64), np.empty(size, np.int64), np.int64(0)
    for point in range(size):
        x, y, z = planes[0, point], planes[1, point], planes[2, point]
        near = around[cell_of[point]]
        keys[point] = _change(
            planes, starts, numbers, near, nothing, reach, scale, x, y, z, crowding
        )
    # Removed points move to the end of their cell: ``at`` is the place of each point.
    heap, at, point_at = np.arange(size), np.arange(size), np.arange(size)
    for i in range(size):
        crowding[i] = keys[i]
    for top in range(size // 2 - 1, -1, -1):
        _sink(heap, keys, order, top)
    remains = np.ones(size, np.bool_)
    left = size
    while left > m:
        point = heap[0]
        place = at[point]
        if keys[point] != crowding[place]:
            # Crowding only falls: a key is an upper bound, and is corrected when it is the largest.
            keys[point] = crowding[place]
        else:
            x, y, z = planes[0, place], planes[1, place], planes[2, place]
            cell = cell_of[point]
            numbers[cell] -= 1
            last = starts[cell] + numbers[cell]
            for axis in range(3):
                planes[axis, place] = planes[axis, last]
            crowding[place], point_at[place] = crowding[last], point_at[last]
            at[point_at[place]] = place
            near = around[cell]
            _change(planes, starts, numbers, near, np.int64(-1), reach, scale, x, y, z, crowding)
            remains[order[point]] = False
            keys[point] = -1  # sinks to the bottom
            left -= 1
        _sink(heap, keys, order, 0)
    return remains
