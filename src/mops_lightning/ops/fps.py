"""Farthest point sampling (Eldar et al., IEEE TIP 1997), from scratch or from a chosen set."""

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from mops_lightning.errors import UserError
from mops_lightning.ops.extreme import blocked_argextreme
from mops_lightning.ops.fps_cpu import (
    squared_lengths_,
    take_farthest_by_groups,
    take_farthest_by_table,
)
from mops_lightning.ops.nearest import nearest
from mops_lightning.ops.points import distance_dtype, gather_points, to_planes

MANY_POINTS, MANY_STEPS = 65536, 256
"""From both on, farthest points of a cloud are faster taken by groups than from all points."""

FEW_CLOUDS, FEW_POINTS = 4, 1024
"""Up to both, many farthest points of a cloud are faster taken from a table of all distances."""


def farthest_point_sample(
    points: Tensor,
    m: int,
    start: int | Tensor | None = None,
    generator: Generator | None = None,
) -> Tensor:
    """Choose m points, each as far as possible from those chosen before it.

    Args:
        points: ``(B, N, C)``.
        m: how many, 1 ≤ m ≤ N.
        start: index of the first point, one for all clouds or ``(B,)``.
        generator: draws the first points where ``start`` is None; without either it is point 0.

    Returns:
        ``(B, m)`` int64, in the order of choice; the first k are the choice for m = k. All differ,
        in coincident points too. The lowest of equally far points is taken.

    Raises:
        UserError: ``m`` or ``start`` is out of range.
    """
    clouds, n = points.shape[:2]
    if not 1 <= m <= n:
        raise UserError(f"m must be between 1 and the number of points N={n}, got {m}.")
    if start is None and generator is not None:
        start = torch.randint(n, (clouds,), generator=generator, device=generator.device)
    first = torch.as_tensor(0 if start is None else start, device=points.device).expand(clouds)
    if bool(((first < 0) | (first >= n)).any()):
        raise UserError(f"start must be between 0 and N-1={n - 1}, got {start}.")
    dtype = distance_dtype(points)
    distances = points.new_full((clouds, n), torch.finfo(dtype).max, dtype=dtype)
    return _take_farthest(points, distances.scatter_(1, first[:, None], torch.inf), m)


def farthest_point_fill(points: Tensor, indices: Tensor, given: Tensor) -> Tensor:
    """Fill up rows of chosen points by farthest point sampling from the chosen ones.

    Args:
        points: ``(B, N, C)``.
        indices: ``(B, M)`` int64, M ≤ N; the first ``given[b]`` entries of row b are chosen points,
            all different; what stands behind them is replaced.
        given: ``(B,)`` int64, 1 ≤ given ≤ M.

    Returns:
        ``(B, M)`` int64, all different: the chosen points, then each time the point farthest from
        all before it.
    """
    wanted = indices.shape[1]
    missing = wanted - int(given.min())
    if missing == 0:
        return indices
    slot = torch.arange(wanted, device=indices.device)
    chosen = torch.where(slot < given[:, None], indices, indices[:, :1])
    distances, _ = nearest(points.detach(), gather_points(points.detach(), chosen))
    distances = distances.to(distance_dtype(points)).scatter_(1, chosen, -1.0)
    more = _take_farthest(points, distances, missing)
    # Clouds that lack fewer points write their surplus behind column M, which is cut off.
    room = torch.cat([chosen, more], 1)
    return room.scatter_(1, given[:, None] + slot[:missing], more)[:, :wanted]


@torch.no_grad()
def _take_farthest(points: Tensor, distances: Tensor, steps: int) -> Tensor:
    """Take the point with the largest distance, lower the distances to it, and so on.

    Args:
        points: ``(B, N, C)``.
        distances: ``(B, N)`` squared distances to start from; what is taken stands at -1, below
            all distances, so that nothing is taken twice.
        steps: how many points to take.

    Returns:
        ``(B, steps)`` int64.
    """
    _, n, channels = points.shape
    few = len(points) <= FEW_CLOUDS and n <= FEW_POINTS and 8 * steps >= n
    many = n >= MANY_POINTS and steps >= MANY_STEPS and channels <= 4
    if points.device.type == "cpu" and (few or many) and bool(points.isfinite().all()):
        take = take_farthest_by_table if few else take_farthest_by_groups
        clouds = zip(points, distances, strict=True)
        return torch.stack([take(*cloud, steps) for cloud in clouds])
    planes = to_planes(points.to(distances.dtype), padding=0.0)
    distances = F.pad(distances, (0, planes.shape[2] - n), value=-1.0)
    differences = torch.empty_like(planes)
    taken = []
    for _ in range(steps):
        index = blocked_argextreme(distances, largest=True)
        taken.append(index)
        distances.scatter_(1, index, -1.0)
        torch.sub(planes, planes.gather(2, index.expand(channels, -1, -1)), out=differences)
        torch.minimum(distances, squared_lengths_(differences), out=distances)
    return torch.cat(taken, 1)
