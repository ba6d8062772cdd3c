"""Voxel sampling with exactly m points, a baseline in the paper's tables."""

import numpy as np
import torch
from torch import Tensor

from mops_lightning.ops.fps import farthest_point_fill
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import SampleOutput

COARSEST, FINEST = -1.0, 20.0
"""Range of log₂(side of the cloud / side of a voxel): one voxel, and the precision of float32."""
BISECTIONS = 24
"""Bisection steps; the relative error of the voxel size is about one in a million."""


class VoxelSampler(Sampler):
    """Divide space into cubic voxels and return one input point for each of m occupied voxels.

    The point of a voxel is the one nearest to the mean of its points. The grid starts at the lowest
    corner of the cloud's bounding box. Bisection finds the largest voxel size of each cloud with at
    least m occupied voxels; where the number of voxels is not monotonic in the size, it finds one
    of several such sizes. The m voxels with the most points are kept and returned in this order;
    ties are broken in (x, y, z) order. If there are fewer than m voxels at the smallest size, 2⁻²⁰
    of the cloud's longest side, because points coincide, farthest point sampling adds input points.
    Flexible, but not nested.

    Args:
        m: largest number of points to return.

    Examples:
        >>> import torch
        >>> from mops_lightning import VoxelSampler
        >>> points = torch.tensor([[[0.0, 0, 0], [0.1, 0, 0], [1, 1, 1]]])
        >>> VoxelSampler(m=2)(points).indices  # (B, N, 3) to (B, m)
        tensor([[0, 2]])
    """

    flexible = True

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return one point for each of m voxels of ``(B, N, 3)`` points."""
        order = seeded_order(points, seed=0)  # ties do not depend on the input order
        ordered = gather_points(points, order)
        population, nearest = group_voxels(ordered, m)
        fullest = population.argsort(dim=1, descending=True, stable=True)[:, :m]
        occupied = population.gather(1, fullest) > 0
        chosen = nearest.gather(1, fullest)
        chosen = farthest_point_fill(ordered, chosen, occupied.sum(1))
        indices = order.gather(1, chosen)
        return SampleOutput(gather_points(points, indices), indices, {})


@torch.no_grad()
def group_voxels(points: Tensor, m: int) -> tuple[Tensor, Tensor]:
    """Group points into voxels of the largest size with at least m occupied voxels.

    Args:
        points: ``(B, N, 3)``; the first of several points nearest to a mean is chosen.
        m: smallest number of occupied voxels, 1 ≤ m ≤ N; there are fewer only if the smallest size
            gives fewer.

    Returns:
        The occupied voxels of every cloud in ascending (x, y, z) order, followed by empty slots:
        ``(B, N)`` int64 number of points in the voxel, 0 for an empty slot, and ``(B, N)`` int64
        row of the input point nearest to the mean of these points.
    """
    key, perm = _voxel_keys(points, m).sort(dim=1, stable=True)
    begins = torch.ones_like(key)
    begins[:, 1:] = key[:, 1:] != key[:, :-1]
    slot = begins.cumsum(1) - 1
    slot3 = slot[..., None].expand(-1, -1, 3)
    population = torch.zeros_like(slot).scatter_add_(1, slot, torch.ones_like(slot))
    # Two points are equally far from their mean; double precision and a tolerance preserve the tie.
    members = gather_points(points, perm).double()
    means = torch.zeros_like(members).scatter_add(1, slot3, members)
    means = means / population.clamp_min(1)[..., None]
    distance = (members - means.gather(1, slot3)).square().sum(2)
    smallest = torch.full_like(distance, torch.inf).scatter_reduce_(1, slot, distance, "amin")
    near = distance <= smallest.gather(1, slot) * (1 + 1e-6)
    rank = torch.where(near, perm, points.shape[1] - 1)
    nearest = torch.full_like(slot, points.shape[1] - 1)
    return population, nearest.scatter_reduce_(1, slot, rank, "amin")


def _voxel_keys(points: Tensor, m: int) -> Tensor:
    """Return the ``(B, N)`` int64 voxel keys at the largest size, ascending in (x, y, z)."""
    points = points.to(torch.promote_types(points.dtype, torch.float32)).permute(2, 0, 1)
    spans = points - points.amin(2, keepdim=True)
    side = spans.amax(2).amax(0)[:, None]
    spans = (spans / side.clamp_min(torch.finfo(points.dtype).tiny)).contiguous()  # (3, B, N)
    coarse = torch.full_like(side, COARSEST)
    fine = torch.full_like(side, FINEST)
    for _ in range(BISECTIONS):
        middle = (coarse + fine) / 2
        enough = _count_distinct(_keys(spans, middle)) >= m
        fine = torch.where(enough, middle, fine)
        coarse = torch.where(enough, coarse, middle)
    return _keys(spans, fine)


def _keys(spans: Tensor, level: Tensor) -> Tensor:
    """Return the voxel keys of ``(3, B, N)`` positions in the unit cube with 2^level per side."""
    x, y, z = (spans * level.exp2()).to(torch.int64)
    return x.mul_(2**42).add_(y, alpha=2**21).add_(z)


def _count_distinct(keys: Tensor) -> Tensor:
    """Count the distinct keys of every row of ``(B, N)``, as ``(B, 1)``."""
    # On a CPU, NumPy's vectorised sort is ten times faster than torch's.
    rows = torch.from_numpy(np.sort(keys.numpy(), 1)) if keys.is_cpu else keys.sort(1).values
    return (rows[:, 1:] != rows[:, :-1]).sum(1, keepdim=True) + 1
