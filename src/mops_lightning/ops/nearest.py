"""Distances to nearest points, by a tree where that is faster than looking at all of them."""

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mops_lightning.ops.points import gather_points, nearest

MANY_PAIRS = 2**24
"""Pairs of points of a cloud from which on a tree is thought of; below, building it costs most."""

PROBES = 64
"""Queries that are looked at to see whether a tree would help."""


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
