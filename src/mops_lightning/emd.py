"""Earth mover's distance of clouds: exact, and by blocks where that would take too long.

EMD(P, Q) = min over bijections φ of 1/N Σ_i ‖p_i − q_φ(i)‖. The search for the bijection runs on
the CPU, without gradients; distances and gradients are then torch's, on any device.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.geometry import gather_points

Array = NDArray[np.float64]
Rows = NDArray[np.int64]


def earth_mover_distance(
    points: Tensor, others: Tensor, block: int | None = None, rounds: int = 4
) -> Tensor:
    """Return the earth mover's distance of two clouds with equally many points.

    Args:
        points: ``(B, N, 3)`` the clouds P.
        others: ``(B, N, 3)`` the clouds Q.
        block: None finds the best of all bijections, in time that grows with N³ at worst; a number
            finds a good one by blocks of so many points, see ``block_matching``.
        rounds: how often the blocks are cut anew.

    Returns:
        ``(B,)`` in units of the coordinates; by blocks it is an upper bound of the exact value.
        Gradients flow to both clouds along the bijection.

    Raises:
        UserError: the shapes differ, or ``block`` or ``rounds`` is out of range.
    """
    match = matching(points, others, block, rounds)
    return torch.linalg.vector_norm(points - gather_points(others, match), dim=2).mean(1)


def matching(points: Tensor, others: Tensor, block: int | None = None, rounds: int = 4) -> Tensor:
    """Return the bijection behind ``earth_mover_distance``: ``(B, N)`` int64 rows of ``others``."""
    if points.shape != others.shape or points.ndim != 3:
        raise UserError(
            "points and others must both be (B, N, 3) with the same N, got "
            f"{tuple(points.shape)} and {tuple(others.shape)}: only then is there a bijection."
        )
    if block is not None and block < 2:
        raise UserError(f"block must be at least 2 points, got {block}.")
    if rounds < 0:
        raise UserError(f"rounds must not be negative, got {rounds}.")
    clouds = [cloud.detach().double().cpu().numpy() for cloud in (points, others)]
    pairs = zip(*clouds, strict=True)
    rows = [_best(p, q) if block is None else block_matching(p, q, block, rounds) for p, q in pairs]
    return torch.from_numpy(np.stack(rows)).to(points.device)


def block_matching(p: Array, q: Array, block: int, rounds: int) -> Rows:
    """Return a good bijection of two clouds ``(N, 3)``, in time N·block² and memory N + block².

    Both clouds are halved at their medians along the same axis again and again; halves are matched
    with halves, and what has at most ``block`` points exactly. Then, in every round, the pairs are
    cut into blocks anew, along axes turned at random (always the same ones) and by the places of
    their points or of their partners in turn, and the pairs of a block are matched anew, exactly.
    A round never makes the bijection worse. Above the exact distance of 512 and 1,024 points by at
    most (measured; see the tests): 8 % with blocks of 128 and 8 rounds, 17 % with 64 and 2.
    """
    match = _halved(p, q, block)
    rng = np.random.default_rng(0)
    for number in range(rounds if len(p) > block else 0):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        places = (q[match] if number % 2 else p) @ turn
        for part in _blocks(places, block):
            match[part] = match[part[_best(p[part], q[match[part]])]]
    return match


def _best(p: Array, q: Array) -> Rows:
    """Return the best bijection of two small clouds."""
    return np.asarray(linear_sum_assignment(cdist(p, q))[1], np.int64)


def _halved(p: Array, q: Array, block: int) -> Rows:
    match = np.empty(len(p), np.int64)
    open_ = [(np.arange(len(p)), np.arange(len(q)))]
    while open_:
        mine, theirs = open_.pop()
        if len(mine) <= block:
            match[mine] = theirs[_best(p[mine], q[theirs])]
            continue
        axis = int(np.concatenate([p[mine], q[theirs]]).var(0).argmax())
        halves = (_halve(p[:, axis], mine), _halve(q[:, axis], theirs))
        open_ += zip(*halves, strict=True)
    return match


def _blocks(places: Array, block: int) -> list[Rows]:
    """Cut ``(N, 3)`` points into boxes of at most ``block``, each across its longest side."""
    done, open_ = [], [np.arange(len(places))]
    while open_:
        part = open_.pop()
        if len(part) <= block:
            done.append(part)
        else:
            open_ += _halve(places[:, int(np.ptp(places[part], axis=0).argmax())], part)
    return done


def _halve(values: Array, rows: Rows) -> tuple[Rows, Rows]:
    """Part rows at the median of their values; of an odd number the second half has one more."""
    half = len(rows) // 2
    order = rows[np.argpartition(values[rows], half)]
    return order[:half], order[half:]
