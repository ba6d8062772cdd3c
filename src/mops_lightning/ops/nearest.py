"""Nearest points, by exhaustive search or by a KD-tree.

Distances are taken as differences of coordinates: |a|² + |b|² − 2⟨a, b⟩ would be one matrix
product, but it suffers from cancellation and returns wrong neighbours where points are 1e-3 apart
in the unit sphere.
"""

import math

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.extreme import blocked_argextreme
from mops_lightning.ops.points import distance_dtype, gather_points, to_planes

BLOCK = {"cpu": 2**19, "other": 2**24}
"""How many distances ``nearest`` holds at a time: what a CPU keeps in its cache; 64 MiB."""

MANY_PAIRS = 2**24
"""Pairs of points of a cloud from which on a tree is thought of; below, building it costs most."""

PROBES = 64
"""Queries that are looked at to see whether a tree would help."""


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


def nearest_distances(queries: Tensor, points: Tensor) -> Tensor:
    """Return the squared distance from every query to its nearest point.

    As ``geometry.nearest`` up to the rounding of the last digit; which of several equally near
    points takes the gradient is not promised. On a CPU large clouds are searched by a KD-tree,
    unless that would have to look at a large part of them: in the midst of a cloud, say, where an
    untrained net puts its points, all are equally far.

    Args:
        queries: ``(B, M, C)``.
        points: ``(B, N, C)``, N ≥ 1.

    Returns:
        ``(B, M)``; gradients flow to both.

    Raises:
        UserError: the shapes do not fit.
    """
    pairs = queries.shape[1] * points.shape[1]
    fits = queries.shape[::2] == points.shape[::2] and queries.device.type == "cpu"
    if not fits or pairs < MANY_PAIRS or not _tree_helps(queries.detach(), points.detach()):
        return nearest(queries, points)[0]
    clouds = zip(queries.detach().double(), points.detach().double(), strict=True)
    workers = torch.get_num_threads()
    rows = [
        cKDTree(cloud.numpy()).query(asked.numpy(), workers=workers)[1] for asked, cloud in clouds
    ]
    found = gather_points(points, torch.stack([torch.from_numpy(row) for row in rows]))
    return (queries - found).square().sum(2)


def _tree_helps(queries: Tensor, points: Tensor) -> bool:
    """Tell whether few points are about as near to a query as the nearest one."""
    if not bool(queries.isfinite().all() and points.isfinite().all()):
        return False
    step = max(queries.shape[1] // PROBES, 1)
    distances = torch.cdist(queries[:, ::step].float(), points.float())
    near = distances <= 1.1 * distances.amin(2, keepdim=True)
    return bool(near.float().mean() < 0.02)


def _check_search(queries: Tensor, points: Tensor) -> None:
    if queries.ndim != 3 or points.ndim != 3 or queries.shape[::2] != points.shape[::2]:
        raise UserError(
            "queries (B, M, C) and points (B, N, C) must agree in B and C, "
            f"got {tuple(queries.shape)} and {tuple(points.shape)}."
        )
    if points.shape[1] == 0:
        raise UserError("points must hold at least one point per cloud, got N=0.")


def _search(queries: Tensor, points: Tensor, k: int) -> Tensor:
    """Return ``(B, M, k)`` nearest; coordinates lie in planes, so that every step is vectorised."""
    dtype = distance_dtype(points)
    rows = to_planes(queries.to(dtype))[..., None]  # (C, B, M, 1)
    columns = to_planes(points.to(dtype), padding=torch.inf)[:, :, None]  # (C, B, 1, N)
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
                blocked_argextreme(flat, largest=False)
                if k == 1
                else flat.topk(k, largest=False)[1]
            )
            indices[b : b + depth, r : r + height] = winners.view(*shape[:2], k)
    return indices
