"""Nearest points, farthest points and the like: pure functions on batches of clouds.

All of them run where their input lies, loop over points at most (over clouds only where these are
large), and measure distances as differences of coordinates: |a|² + |b|² − 2⟨a, b⟩ would be one
matrix product, but it cancels, and takes wrong neighbours where points lie 1e-3 apart in the unit
sphere.
"""

import math

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from mops_lightning.errors import UserError
from mops_lightning.ops.fps import (
    squared_lengths_,
    take_farthest_by_groups,
    take_farthest_by_table,
)

GROUP, FEW = 32, 8192
"""Values per group in ``first_extreme``, and up to how many values groups do not pay there."""
BLOCK = {"cpu": 2**19, "other": 2**24}
"""How many distances ``nearest`` holds at a time: what a CPU keeps in its cache; 64 MiB."""

MANY_POINTS, MANY_STEPS = 65536, 256
"""From both on, farthest points of a cloud are faster taken by groups than from all points."""
FEW_CLOUDS, FEW_POINTS = 4, 1024
"""Up to both, many farthest points of a cloud are faster taken from a table of all distances."""


def gather_points(points: Tensor, indices: Tensor) -> Tensor:
    """Take rows of every cloud.

    Args:
        points: ``(B, N, C)``.
        indices: ``(B, M)`` int64, rows of ``points``.

    Returns:
        ``(B, M, C)``; gradients flow to ``points``.
    """
    return points.gather(1, indices[..., None].expand(-1, -1, points.shape[2]))


def normalize_unit_sphere(points: Tensor) -> Tensor:
    """Move every centroid to the origin and scale every cloud to a largest norm of 1.

    Args:
        points: ``(B, N, C)``.

    Returns:
        ``(B, N, C)``; a cloud whose points all coincide becomes zeros.
    """
    centred = points - points.mean(1, keepdim=True)
    radius = torch.linalg.vector_norm(centred, dim=2, keepdim=True).amax(1, keepdim=True)
    # The mean of equal numbers may be off by a rounding error, which must not be blown up.
    flat = (points == points[:, :1]).all(2, keepdim=True).all(1, keepdim=True) | (radius == 0)
    return torch.where(flat, 0.0, centred / torch.where(flat, 1.0, radius))


def nearest(queries: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Find the nearest point of a cloud for every query by looking at all of them.

    The search runs in blocks, so that memory stays bounded. (A KD-tree is faster where queries lie
    on the cloud, but many times slower in its midst, where an untrained sampler puts them.)

    Args:
        queries: ``(B, M, C)``.
        points: ``(B, N, C)``, N ≥ 1.

    Returns:
        Squared distances ``(B, M)``, through which gradients flow to queries and points, and the
        indices ``(B, M)`` int64 of the nearest points, the lowest where several are nearest.

    Raises:
        UserError: the shapes do not fit.
    """
    _check_search(queries, points)
    with torch.no_grad():
        indices = _search(queries, points, 1)[..., 0]
    return (queries - gather_points(points, indices)).square().sum(2), indices


def k_nearest(queries: Tensor, points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Find the k nearest points of a cloud for every query by looking at all of them.

    Args:
        queries: ``(B, M, C)``.
        points: ``(B, N, C)``.
        k: how many, 1 ≤ k ≤ N.

    Returns:
        Squared distances ``(B, M, k)``, ascending, through which gradients flow to queries and
        points, and the indices ``(B, M, k)`` int64. Which of equally near points are taken is not
        defined for k > 1.

    Raises:
        UserError: the shapes do not fit, or k is out of its range.
    """
    _check_search(queries, points)
    if not 1 <= k <= points.shape[1]:
        raise UserError(f"k must be from 1 to the number of points N={points.shape[1]}, got {k}.")
    with torch.no_grad():
        indices = _search(queries, points, k)
    neighbours = gather_points(points, indices.flatten(1)).unflatten(1, indices.shape[1:])
    return (queries[:, :, None] - neighbours).square().sum(3), indices


def _check_search(queries: Tensor, points: Tensor) -> None:
    if queries.ndim != 3 or points.ndim != 3 or queries.shape[::2] != points.shape[::2]:
        raise UserError(
            "queries (B, M, C) and points (B, N, C) must agree in B and C, "
            f"got {tuple(queries.shape)} and {tuple(points.shape)}."
        )
    if points.shape[1] == 0:
        raise UserError("points must hold at least one point per cloud, got N=0.")


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
    dtype = _search_dtype(points)
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
    distances = distances.to(_search_dtype(points)).scatter_(1, chosen, -1.0)
    more = _take_farthest(points, distances, missing)
    # Clouds that lack fewer points write their surplus behind column M, which is cut off.
    room = torch.cat([chosen, more], 1)
    return room.scatter_(1, given[:, None] + slot[:missing], more)[:, :wanted]


def first_extreme(values: Tensor, largest: bool) -> Tensor:
    """Return ``values.argmax(1, keepdim=True)`` or ``argmin``, several times as fast on a CPU.

    Extremes alone are vectorised there, extremes with positions are not: so take those of groups,
    and look for positions only among the groups and inside the winning one.

    Args:
        values: ``(rows, L)``, L a multiple of ``GROUP``.
        largest: look for the maximum, else for the minimum.

    Returns:
        ``(rows, 1)`` int64; the lowest position where several values are equal.
    """
    if values.numel() <= FEW:
        return values.argmax(1, keepdim=True) if largest else values.argmin(1, keepdim=True)
    groups = values.view(len(values), -1, GROUP)
    peaks = groups.amax(2) if largest else groups.amin(2)
    group = peaks.argmax(1, keepdim=True) if largest else peaks.argmin(1, keepdim=True)
    inside = groups.gather(1, group[..., None].expand(-1, 1, GROUP))
    place = inside.argmax(2) if largest else inside.argmin(2)
    return place.add_(group, alpha=GROUP)


def _search_dtype(points: Tensor) -> torch.dtype:
    """Half precision is too coarse to compare distances in."""
    return torch.promote_types(points.dtype, torch.float32)


def _planes(points: Tensor, padding: float | None = None) -> Tensor:
    """Turn ``(B, N, C)`` into contiguous ``(C, B, N)``, N padded to whole groups if asked."""
    planes = points.permute(2, 0, 1)
    if padding is not None:
        planes = F.pad(planes, (0, -points.shape[1] % GROUP), value=padding)
    return planes.contiguous()


def _search(queries: Tensor, points: Tensor, k: int) -> Tensor:
    """Return ``(B, M, k)`` nearest; coordinates lie in planes, so that every step is vectorised."""
    dtype = _search_dtype(points)
    rows = _planes(queries.to(dtype))[..., None]  # (C, B, M, 1)
    columns = _planes(points.to(dtype), padding=torch.inf)[:, :, None]  # (C, B, 1, N)
    clouds, m, width = queries.shape[0], queries.shape[1], columns.shape[3]
    limit = BLOCK["cpu" if points.device.type == "cpu" else "other"]
    height = max(1, min(m, limit // width))
    depth = max(1, min(clouds, limit // (height * width)))
    indices = torch.empty(clouds, m, k, dtype=torch.int64, device=points.device)
    buffers = rows.new_empty(2, depth * height * width)  # allocating per block costs a third more
    for b in range(0, clouds, depth):
        for r in range(0, m, height):
            part = rows[:, b : b + depth, r : r + height]
            shape = (*part.shape[1:3], width)
            total, difference = buffers[:, : math.prod(shape)].view(2, *shape)
            torch.sub(columns[0, b : b + depth], part[0], out=total)
            total.mul_(total)
            for axis in range(1, len(rows)):
                torch.sub(columns[axis, b : b + depth], part[axis], out=difference)
                total.addcmul_(difference, difference)
            flat = total.view(-1, width)
            winners = (
                first_extreme(flat, largest=False) if k == 1 else flat.topk(k, largest=False)[1]
            )
            indices[b : b + depth, r : r + height] = winners.view(*shape[:2], k)
    return indices


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
    planes = _planes(points.to(distances.dtype), padding=0.0)
    distances = F.pad(distances, (0, planes.shape[2] - n), value=-1.0)
    differences = torch.empty_like(planes)
    taken = []
    for _ in range(steps):
        index = first_extreme(distances, largest=True)
        taken.append(index)
        distances.scatter_(1, index, -1.0)
        torch.sub(planes, planes.gather(2, index.expand(channels, -1, -1)), out=differences)
        torch.minimum(distances, squared_lengths_(differences), out=distances)
    return torch.cat(taken, 1)
