"""Assignment of one point cloud to another: the bijection with the smallest sum of distances.

``solve_assignment`` is exact; ``approximate_assignment`` splits large clouds into blocks. The
module uses NumPy and SciPy only: worker processes import it, and start faster without torch.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

NETWORK_SIMPLEX_MIN_POINTS = 1024
"""Minimum number of points for solving the assignment with POT's network simplex."""

Array = NDArray[np.float64]
Rows = NDArray[np.int64]


def approximate_assignment(p: Array, q: Array, block: int, rounds: int) -> Rows:
    """Return an assignment of low cost, in O(N·block²) time and O(N + block²) memory.

    First, both clouds are split recursively at their medians along a common axis, and parts of at
    most ``block`` points are assigned exactly. Then every round splits the pairs into new blocks,
    along randomly rotated axes (with a fixed seed) and by the positions of ``p`` and ``q`` in turn,
    and solves each block exactly. The cost never increases from round to round. For 512 and 1,024
    points, the measured cost exceeds the exact one by at most 8 % with block=128 and rounds=8, and
    by at most 17 % with block=64 and rounds=2.

    Args:
        p: ``(N, 3)``.
        q: ``(N, 3)``.
        block: largest number of points in a block.
        rounds: number of improvement rounds.

    Returns:
        ``(N,)`` rows of ``q``; row i is assigned to ``p[i]``.
    """
    assigned = _assign_by_bisection(p, q, block)
    rng = np.random.default_rng(0)
    if len(p) <= block:
        return assigned
    for number in range(rounds):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        positions = p
        if number % 2:
            positions = q[assigned]
        for rows in _split_into_blocks(positions @ rotation, block):
            partners = assigned[rows]
            order = solve_assignment(p[rows], q[partners])
            assigned[rows] = partners[order]
    return assigned


def solve_assignment(p: Array, q: Array) -> Rows:
    """Return the assignment with the smallest sum of Euclidean distances.

    Small problems use SciPy's shortest augmenting paths, large ones POT's network simplex: for
    2,048 points against a dense cluster, SciPy took 4.7 s and POT 1.2 s on one core.

    Args:
        p: ``(N, 3)``.
        q: ``(N, 3)``.

    Returns:
        ``(N,)`` rows of ``q``; row i is assigned to ``p[i]``.
    """
    cost = cdist(p, q)
    if len(p) >= NETWORK_SIMPLEX_MIN_POINTS:
        from ot import emd

        weights = np.full(len(p), 1 / len(p))
        plan = np.asarray(emd(weights, weights, cost, numItermax=10**8))
        rows = plan.argmax(1)
        # A vertex of the transport polytope is a bijection, except for rounding errors.
        if len(np.unique(rows)) == len(p):
            return rows.astype(np.int64)
    return np.asarray(linear_sum_assignment(cost)[1], np.int64)


def _assign_by_bisection(p: Array, q: Array, block: int) -> Rows:
    """Split both clouds at their medians until parts have at most ``block`` points; solve these."""
    assigned = np.empty(len(p), np.int64)
    all_rows = np.arange(len(p))
    stack = [(all_rows, np.arange(len(q)))]
    while stack:
        p_rows, q_rows = stack.pop()
        if len(p_rows) <= block:
            order = solve_assignment(p[p_rows], q[q_rows])
            assigned[p_rows] = q_rows[order]
            continue
        points = np.concatenate([p[p_rows], q[q_rows]])
        axis = int(points.var(0).argmax())
        p_halves = _split_at_median(p[:, axis], p_rows)
        q_halves = _split_at_median(q[:, axis], q_rows)
        stack += zip(p_halves, q_halves, strict=True)
    return assigned


def _split_into_blocks(positions: Array, block: int) -> list[Rows]:
    """Split ``(N, 3)`` points across their longest sides into sets of at most ``block`` rows."""
    blocks = []
    stack = [np.arange(len(positions))]
    while stack:
        rows = stack.pop()
        if len(rows) <= block:
            blocks.append(rows)
        else:
            extents = np.ptp(positions[rows], axis=0)
            axis = int(extents.argmax())
            stack += _split_at_median(positions[:, axis], rows)
    return blocks


def _split_at_median(values: Array, rows: Rows) -> tuple[Rows, Rows]:
    """Split rows at the median of their values; the second half has the odd row."""
    half = len(rows) // 2
    order = rows[np.argpartition(values[rows], half)]
    return order[:half], order[half:]
