"""Nearest neighbours and the chamfer distance.

The search is exhaustive, or runs in compiled loops over a tree on a CPU.

Distances are computed from differences of coordinates. The form |a|² + |b|² − 2⟨a, b⟩ would be a
single matrix product, but its cancellation error gives wrong neighbours for points that are 1e-3
apart in the unit sphere.
"""

import math

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops import compiled
from mops_lightning.ops.points import distance_dtype, gather_points, to_planes

BLOCK = {"cpu": 2**19, "other": 2**24}
"""Distances in memory at a time: a CPU keeps these in its cache; 64 MiB on other devices."""


def nearest(queries: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Find the nearest point for every query, with bounded memory.

    Args:
        queries: ``(B, M, C)``.
        points: ``(B, N, C)``, N ≥ 1.

    Returns:
        Squared distances ``(B, M)``, through which gradients flow to queries and points, and the
        indices ``(B, M)`` int64 of the nearest points, the lowest index in case of ties.

    Raises:
        UserError: the shapes do not match, or N is 0.

    Examples:
        >>> import torch
        >>> from mops_lightning import nearest
        >>> queries, points = torch.tensor([[[0.0], [4.0]]]), torch.tensor([[[1.0], [6.0]]])
        >>> nearest(queries, points)
        (tensor([[1., 4.]]), tensor([[0, 1]]))
    """
    _check_shapes(queries, points)
    with torch.no_grad():
        indices = _search(queries, points, 1)[..., 0]
    differences = queries - gather_points(points, indices)
    return differences.square().sum(2), indices


def k_nearest(queries: Tensor, points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Find the k nearest points for every query by exhaustive search.

    Args:
        queries: ``(B, M, C)``.
        points: ``(B, N, C)``.
        k: number of neighbours, 1 ≤ k ≤ N.

    Returns:
        Squared distances ``(B, M, k)``, ascending, through which gradients flow to queries and
        points, and the indices ``(B, M, k)`` int64, of ties the lowest index on a CPU.

    Raises:
        UserError: the shapes do not match, or k is out of range.
    """
    indices = k_nearest_rows(queries, points, k)
    neighbours = gather_points(points, indices)
    differences = queries[:, :, None] - neighbours
    return differences.square().sum(3), indices


@torch.no_grad()
def k_nearest_rows(queries: Tensor, points: Tensor, k: int) -> Tensor:
    """Return the indices of ``k_nearest`` alone; arguments and errors as there."""
    _check_shapes(queries, points)
    number = points.shape[1]
    if not 1 <= k <= number:
        raise UserError(f"k must be from 1 to the number of points N={number}, got {k}.")
    return _search(queries, points, k)


@torch.no_grad()
def nearest_features(features: Tensor, k: int) -> Tensor:
    """Return the rows of the k nearest points of every point in the space of features.

    On a CPU, compiled loops compare differences. On other devices, a matrix product is faster for
    many channels; its cancellation can swap neighbours that are nearly as near.

    Args:
        features: ``(B, N, C)``.
        k: number of neighbours, the point itself included; N if there are fewer.

    Returns:
        ``(B, N, k)`` int64, nearest first.
    """
    k = min(k, features.shape[1])
    if not torch.compiler.is_compiling():  # a graph cannot contain compiled loops
        rows = compiled.nearest(features, features, k)
        if rows is not None:
            return rows
    return search_by_product(features, k)


def search_by_product(features: Tensor, k: int) -> Tensor:
    """Find nearest features in torch; arguments as for ``nearest_features``, k at most N."""
    return torch.cdist(features, features).topk(k, largest=False).indices


def chamfer_distance(points: Tensor, others: Tensor) -> Tensor:
    """Return the squared chamfer distance: the sum of the mean over both directions.

    CD(P, Q) = 1/|P| Σ_p min_q ‖p − q‖² + 1/|Q| Σ_q min_p ‖q − p‖². Memory does not grow with
    |P|·|Q|; gradients flow to both clouds through the nearest points.

    Args:
        points: ``(B, N, 3)`` clouds P.
        others: ``(B, M, 3)`` clouds Q.

    Returns:
        ``(B,)`` in squared units of the coordinates.

    Raises:
        UserError: the shapes do not match, or a cloud is empty.

    Examples:
        >>> import torch
        >>> from mops_lightning import chamfer_distance
        >>> chamfer_distance(torch.zeros(1, 4, 3), torch.ones(1, 2, 3))
        tensor([6.])
    """
    from_points, _ = nearest(points, others)
    from_others, _ = nearest(others, points)
    return from_points.mean(1) + from_others.mean(1)


def _check_shapes(queries: Tensor, points: Tensor) -> None:
    have_three_dimensions = queries.ndim == 3 and points.ndim == 3
    if not have_three_dimensions or queries.shape[::2] != points.shape[::2]:
        raise UserError(
            "queries (B, M, C) and points (B, N, C) must agree in B and C, "
            f"got {tuple(queries.shape)} and {tuple(points.shape)}."
        )
    if points.shape[1] == 0:
        raise UserError("points must have at least one point per cloud, got N=0.")


def _search(queries: Tensor, points: Tensor, k: int) -> Tensor:
    """Return the ``(B, M, k)`` nearest rows."""
    if not torch.compiler.is_compiling():  # a graph cannot contain compiled loops
        rows = compiled.nearest(queries, points, k)
        if rows is not None:
            return rows
    return search_in_blocks(queries, points, k)


def search_in_blocks(queries: Tensor, points: Tensor, k: int) -> Tensor:
    """Find the k nearest rows ``(B, M, k)`` in torch; planes keep every step vectorised."""
    dtype = distance_dtype(points)
    query_planes = to_planes(queries.to(dtype))
    rows = query_planes[..., None]  # (C, B, M, 1)
    point_planes = to_planes(points.to(dtype))
    columns = point_planes[:, :, None]  # (C, B, 1, N)
    clouds, m = queries.shape[:2]
    width = points.shape[1]
    limit = BLOCK["other"]
    if points.device.type == "cpu":
        limit = BLOCK["cpu"]
    height = max(1, min(m, limit // width))
    clouds_at_once = limit // (height * width)
    depth = max(1, min(clouds, clouds_at_once))
    indices = torch.empty(clouds, m, k, dtype=torch.int64, device=points.device)
    buffers = rows.new_empty(2, depth * height * width)  # one allocation saves a third of the time
    for cloud in range(0, clouds, depth):
        some_clouds = slice(cloud, cloud + depth)
        for row in range(0, m, height):
            some_rows = slice(row, row + height)
            block = rows[:, some_clouds, some_rows]
            shape = (*block.shape[1:3], width)
            used = buffers[:, : math.prod(shape)]
            total, difference = used.view(2, *shape)
            torch.sub(columns[0, some_clouds], block[0], out=total)
            total.mul_(total)
            for axis in range(1, len(rows)):
                column = columns[axis, some_clouds]
                torch.sub(column, block[axis], out=difference)
                total.addcmul_(difference, difference)
            winners = _smallest(total.view(-1, width), k)
            winners = winners.view(*shape[:2], k)
            indices[some_clouds, some_rows] = winners
    return indices


def _smallest(distances: Tensor, k: int) -> Tensor:
    """Return the columns of the k smallest numbers of every row; for k = 1 the lowest of ties."""
    if k == 1:
        return distances.argmin(1)  # topk would break ties arbitrarily
    return distances.topk(k, largest=False).indices
