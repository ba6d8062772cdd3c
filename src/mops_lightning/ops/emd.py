"""Earth mover's distance between point clouds, exact or approximated in blocks.

EMD(P, Q) = min over bijections φ of 1/N Σ_i ‖p_i − q_φ(i)‖. The assignment φ is solved on the CPU,
without gradients; torch computes the distances and their gradients on any device.
"""

from concurrent.futures.process import BrokenProcessPool
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.errors import UserError, check_at_least
from mops_lightning.ops.assignment import Rows, approximate_assignment, solve_assignment
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.workers import pool

WORKERS_MIN_POINTS = 8192
"""Minimum number of points in a batch for using worker processes, which start in a second."""


def earth_movers_distance(
    points: Tensor,
    others: Tensor,
    block: int | None = None,
    rounds: int = 4,
    workers: int = 1,
) -> Tensor:
    """Return the earth mover's distance between clouds with the same number of points.

    Args:
        points: ``(B, N, 3)`` clouds P.
        others: ``(B, N, 3)`` clouds Q.
        block: None solves the assignment exactly, in O(N³) time at worst; a number approximates it
            in blocks of at most this many points, see ``assignment.approximate_assignment``.
        rounds: number of improvement rounds of the approximation.
        workers: worker processes that share the clouds of a batch. The result does not depend on
            it. A script that uses more than one needs an ``if __name__ == "__main__":`` guard.

    Returns:
        ``(B,)`` in units of the coordinates; the approximation is an upper bound. Gradients flow
        to both clouds through the assigned pairs. Not finite for clouds that are not.

    Raises:
        UserError: the shapes differ, an argument is out of range, or a worker process died.

    Examples:
        >>> import torch
        >>> from mops_lightning import earth_movers_distance
        >>> points = torch.rand(2, 16, 3)
        >>> earth_movers_distance(points, points.flip(1))
        tensor([0., 0.])
    """
    rows = solve_assignments(points, others, block, rounds, workers)
    return torch.linalg.vector_norm(points - gather_points(others, rows), dim=2).mean(1)


def solve_assignments(
    points: Tensor,
    others: Tensor,
    block: int | None = None,
    rounds: int = 4,
    workers: int = 1,
) -> Tensor:
    """Return the assignment whose mean distance is the earth mover's distance.

    Arguments and errors as in ``earth_movers_distance``.

    Returns:
        ``(B, N)`` int64 rows of ``others``, a permutation for every cloud.
    """
    if points.shape != others.shape or points.ndim != 3:
        raise UserError(
            "points and others must both be (B, N, 3) with the same N, got "
            f"{tuple(points.shape)} and {tuple(others.shape)}."
        )
    if block is not None:
        check_at_least(2, block=block)
    check_at_least(0, rounds=rounds)
    check_at_least(1, workers=workers)
    p, q = _solvable(points), _solvable(others)
    solve = (
        partial(approximate_assignment, block=block, rounds=rounds) if block else solve_assignment
    )
    workers = min(workers, len(p))
    if workers < 2 or points[..., 0].numel() < WORKERS_MIN_POINTS:
        rows: list[Rows] = list(map(solve, p, q))
    else:
        try:
            rows = list(pool(workers).map(solve, p, q))
        except BrokenProcessPool as error:
            pool.cache_clear()
            raise UserError(
                "workers: a process that solved assignments died. Either memory ran out, "
                "or the calling script has no 'if __name__ == \"__main__\":' guard. Use one thread "
                "(OMP_NUM_THREADS=1), or workers=1."
            ) from error
    return torch.from_numpy(np.stack(rows)).to(points.device)


def _solvable(clouds: Tensor) -> NDArray[np.float64]:
    """Return clouds ``(B, N, 3)`` as arrays, with zeros for those that are not finite.

    No assignment exists for these, and any one gives a distance that is not finite.
    """
    exact = clouds.detach().double().cpu()
    finite = exact.isfinite().flatten(1).all(1)
    return torch.where(finite[:, None, None], exact, 0.0).numpy()
