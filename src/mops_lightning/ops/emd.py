"""Earth mover's distance of clouds: exact, and by blocks where that would take too long.

EMD(P, Q) = min over bijections φ of 1/N Σ_i ‖p_i − q_φ(i)‖. The search for the bijection runs on
the CPU, without gradients; distances and gradients are then torch's, on any device.
"""

from concurrent.futures.process import BrokenProcessPool
from functools import partial

import numpy as np
import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.assignment import Rows, best_matching, block_matching
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.workers import pool

WORTHWHILE = 8192
"""Points of a batch from which on other processes are asked; starting them takes a second."""


def earth_movers_distance(
    points: Tensor,
    others: Tensor,
    block: int | None = None,
    rounds: int = 4,
    workers: int | None = 1,
) -> Tensor:
    """Return the earth mover's distance of two clouds with equally many points.

    Args:
        points: ``(B, N, 3)`` the clouds P.
        others: ``(B, N, 3)`` the clouds Q.
        block: None finds the best of all bijections, in time that grows with N³ at worst; a number
            finds a good one by blocks of so many points, see ``matchings.block_matching``.
        rounds: how often the blocks are cut anew.
        workers: processes that share the clouds of a batch; None: as many as torch has threads.
            The result does not depend on it. A script that asks for more than one needs an
            ``if __name__ == "__main__":``.

    Returns:
        ``(B,)`` in units of the coordinates; by blocks it is an upper bound of the exact value.
        Gradients flow to both clouds along the bijection.

    Raises:
        UserError: the shapes differ, a number is out of range, or a worker died.
    """
    match = matching(points, others, block, rounds, workers)
    return torch.linalg.vector_norm(points - gather_points(others, match), dim=2).mean(1)


def matching(
    points: Tensor,
    others: Tensor,
    block: int | None = None,
    rounds: int = 4,
    workers: int | None = 1,
) -> Tensor:
    """Return the bijection of ``earth_movers_distance``: ``(B, N)`` int64 rows of ``others``."""
    if points.shape != others.shape or points.ndim != 3:
        raise UserError(
            "points and others must both be (B, N, 3) with the same N, got "
            f"{tuple(points.shape)} and {tuple(others.shape)}: only then is there a bijection."
        )
    if block is not None and block < 2:
        raise UserError(f"block must be at least 2 points, got {block}.")
    if rounds < 0:
        raise UserError(f"rounds must not be negative, got {rounds}.")
    if workers is not None and workers < 1:
        raise UserError(f"workers must be at least 1, or null for all cores, got {workers}.")
    p, q = (cloud.detach().double().cpu().numpy() for cloud in (points, others))
    find = partial(block_matching, block=block, rounds=rounds) if block else best_matching
    workers = min(workers or torch.get_num_threads(), len(p))
    if workers < 2 or points[..., 0].numel() < WORTHWHILE:
        rows: list[Rows] = list(map(find, p, q))
    else:
        try:
            rows = list(pool(workers).map(find, p, q))
        except BrokenProcessPool as error:
            pool.cache_clear()
            raise UserError(
                "emd_workers: a process that matched points died, perhaps for want of memory, or "
                "because the script that started it has no 'if __name__ == \"__main__\":'. "
                "Try emd_workers=1 (task.emd_workers=1 on the command line)."
            ) from error
    return torch.from_numpy(np.stack(rows)).to(points.device)
