"""Choices of points that hold a pose, in loops that numba compiles for ``ops.stability``."""

# mypy: disable-error-code="no-untyped-def"

from heapq import heapify, heappop, heapreplace

import numpy as np

from mops_lightning.ops.jit import jit, jit_cached


@jit_cached
def cover_least_held(squares, orders, m):
    """Choose m points, each for the direction that the points chosen so far hold least.

    Args:
        squares: ``(N, D)`` what every point adds to the stability of each of D directions.
        orders: ``(D, N)`` the points of every direction, those that add most first.
        m: number of points.

    Returns:
        ``(m,)`` places, in the order of choice.
    """
    number = squares.shape[1]
    totals = np.zeros(number)
    heads = np.zeros(number, np.int64)
    taken = np.zeros(len(squares), np.bool_)
    chosen = np.empty(m, np.int64)
    for step in range(m):
        weakest = 0
        for direction in range(1, number):
            if totals[direction] < totals[weakest]:
                weakest = direction
        while taken[orders[weakest, heads[weakest]]]:
            heads[weakest] += 1
        place = orders[weakest, heads[weakest]]
        taken[place] = True
        chosen[step] = place
        for direction in range(number):
            totals[direction] += squares[place, direction]
    return chosen


@jit
def _leverage(rows, place, inverse):
    """Return v A⁻¹ v of a row v."""
    total = 0.0
    for a in range(6):
        partial = 0.0
        for b in range(6):
            partial += inverse[a, b] * rows[place, b]
        total += partial * rows[place, a]
    return total


@jit
def _add(rows, place, inverse, product):
    """Update A⁻¹ for A + v vᵀ (Sherman and Morrison)."""
    for a in range(6):
        product[a] = 0.0
        for b in range(6):
            product[a] += inverse[a, b] * rows[place, b]
    scale = 1.0
    for a in range(6):
        scale += product[a] * rows[place, a]
    for a in range(6):
        for b in range(6):
            inverse[a, b] -= product[a] * product[b] / scale


@jit_cached
def grow_information(rows, prior, m):
    """Choose m points, each of which raises log det (prior·I + Σ v vᵀ) most.

    The leverage of a point only falls when others are chosen. The last value that was computed is
    therefore an upper bound, and is computed again only when it is the largest (lazy greedy). All
    values are computed again after 1, 2, 4, 8, … points, when most bounds are far too high.

    Args:
        rows: ``(N, 6)`` the vectors v.
        prior: above 0.
        m: number of points.

    Returns:
        ``(m,)`` places, in the order of choice; of equal gains the lowest place.
    """
    inverse = np.eye(6) / prior
    product = np.empty(6)
    taken = np.zeros(len(rows), np.bool_)
    chosen = np.empty(m, np.int64)
    heap = [(-_leverage(rows, i, inverse), i, 0) for i in range(len(rows))]
    heapify(heap)
    for step in range(m):
        if step & (step - 1) == 0 and step > 0:
            left = [i for i in range(len(rows)) if not taken[i]]
            heap = [(-_leverage(rows, i, inverse), i, step) for i in left]
            heapify(heap)
        place, computed = heap[0][1], heap[0][2]
        while computed != step:
            heapreplace(heap, (-_leverage(rows, place, inverse), place, step))
            place, computed = heap[0][1], heap[0][2]
        heappop(heap)
        taken[place] = True
        chosen[step] = place
        _add(rows, place, inverse, product)
    return chosen
