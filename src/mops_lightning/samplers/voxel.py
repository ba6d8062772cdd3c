"""Voxel sampling, a baseline of the paper's tables, with exactly m points."""

from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.ops.fps import farthest_point_fill
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import SampleOutput

COARSEST, FINEST = -1.0, 20.0
"""Range of log₂(longest side of the cloud / side of a voxel): one voxel; as far as float32 goes."""
HALVINGS = 24
"""Steps of the search: the voxel size is right to one part in a million."""


class Voxels(NamedTuple):
    """The occupied voxels of every cloud, in ascending (x, y, z) order; N slots, the last empty.

    Attributes:
        population: ``(B, N)`` int64 points in the voxel, 0 in an empty slot.
        means: ``(B, N, 3)`` their mean.
        nearest: ``(B, N)`` int64 the input point nearest to the mean.
    """

    population: Tensor
    means: Tensor
    nearest: Tensor


class VoxelSampler(Sampler):
    """Lay a grid of cubes over the cloud and choose one point for each of m occupied ones.

    The grid starts at the lowest corner of the cloud's bounding box. Its voxel size is the largest
    with at least m occupied voxels, found for each cloud by bisection (the number of voxels can
    rise and fall again within a narrow range of sizes; then it is one such size). Of the occupied
    voxels the m with most points stay, among equals those that come first in (x, y, z) order, and
    in this order they are returned. Where even voxels of 2⁻²⁰ of the cloud's longest side are less
    than m, because points coincide, farthest point sampling from the chosen points fills up with
    input points. Flexible: any m up to the given one.

    Args:
        m: largest number of points to return.
        pick: ``nearest`` returns the input point nearest to the mean of its voxel's points, with
            indices; ``centroid`` returns the mean itself, without.

    Raises:
        UserError: ``pick`` is neither.

    Example:
        >>> import torch
        >>> from mops_lightning import VoxelSampler
        >>> points = torch.tensor([[[0.0, 0, 0], [0.1, 0, 0], [1, 1, 1]]])
        >>> VoxelSampler(m=2, pick="centroid")(points).points  # (B, N, 3) to (B, m, 3)
        tensor([[[0.0500, 0.0000, 0.0000],
                 [1.0000, 1.0000, 1.0000]]])
    """

    flexible = True

    def __init__(self, m: int, pick: Literal["nearest", "centroid"] = "nearest") -> None:
        super().__init__(m)
        if pick not in ("nearest", "centroid"):
            hint = did_you_mean(pick, ("nearest", "centroid"))
            raise UserError(f"sampler.pick: unknown {pick!r}.{hint}")
        self.pick = pick
        self.generates = pick == "centroid"

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return one point for each of m voxels of ``(B, N, 3)`` points."""
        order = seeded_order(points, seed=0)  # so that ties do not depend on the order given
        ordered = gather_points(points, order)
        voxels = group_voxels(ordered, m)
        fullest = voxels.population.argsort(dim=1, descending=True, stable=True)[:, :m]
        occupied = voxels.population.gather(1, fullest) > 0
        chosen = voxels.nearest.gather(1, fullest)
        chosen = farthest_point_fill(ordered, chosen, occupied.sum(1))
        if self.pick == "centroid":
            means = gather_points(voxels.means, fullest)
            filled = gather_points(ordered, chosen)
            return SampleOutput(torch.where(occupied[..., None], means, filled), None, {})
        indices = order.gather(1, chosen)
        return SampleOutput(gather_points(points, indices), indices, {})


def group_voxels(points: Tensor, m: int) -> Voxels:
    """Sort points into the largest voxels of which at least m are occupied.

    Args:
        points: ``(B, N, 3)``; of points equally near to a mean the first is taken.
        m: how many voxels, 1 ≤ m ≤ N; fewer only if the smallest size gives fewer.

    Returns:
        The voxels; gradients flow from the means to the points.
    """
    key, perm = _voxel_keys(points.detach(), m).sort(dim=1, stable=True)
    begins = torch.ones_like(key)
    begins[:, 1:] = key[:, 1:] != key[:, :-1]
    slot = begins.cumsum(1) - 1
    slot3 = slot[..., None].expand(-1, -1, 3)
    population = torch.zeros_like(slot).scatter_add_(1, slot, torch.ones_like(slot))
    # Two points are equally far from their mean: double precision, and a tolerance, keep them so.
    members = gather_points(points, perm).double()
    means = torch.zeros_like(members).scatter_add(1, slot3, members)
    means = means / population.clamp_min(1)[..., None]
    with torch.no_grad():
        distance = (members - means.gather(1, slot3)).square().sum(2)
        least = torch.full_like(distance, torch.inf).scatter_reduce_(1, slot, distance, "amin")
        near = distance <= least.gather(1, slot) * (1 + 1e-6)
        rank = torch.where(near, perm, points.shape[1] - 1)
        nearest = torch.full_like(slot, points.shape[1] - 1)
        nearest.scatter_reduce_(1, slot, rank, "amin")
    return Voxels(population, means.to(points.dtype), nearest)


@torch.no_grad()
def _voxel_keys(points: Tensor, m: int) -> Tensor:
    """Return ``(B, N)`` int64 numbers of the voxels of the largest size, ascending in (x, y, z)."""
    points = points.to(torch.promote_types(points.dtype, torch.float32)).permute(2, 0, 1)
    spans = points - points.amin(2, keepdim=True)
    side = spans.amax(2).amax(0)[:, None]
    spans = (spans / side.clamp_min(torch.finfo(points.dtype).tiny)).contiguous()  # (3, B, N)
    coarse = torch.full_like(side, COARSEST)
    fine = torch.full_like(side, FINEST)
    for _ in range(HALVINGS):
        middle = (coarse + fine) / 2
        enough = _count_different(_keys(spans, middle)) >= m
        fine = torch.where(enough, middle, fine)
        coarse = torch.where(enough, coarse, middle)
    return _keys(spans, fine)


def _keys(spans: Tensor, level: Tensor) -> Tensor:
    """Number the voxels for ``(3, B, N)`` places in the unit cube, cut 2^level times per side."""
    x, y, z = (spans * level.exp2()).to(torch.int64)
    return x.mul_(2**42).add_(y, alpha=2**21).add_(z)


def _count_different(keys: Tensor) -> Tensor:
    """Count the different numbers in every row of ``(B, N)``, as ``(B, 1)``."""
    # On a CPU NumPy's vectorised sort takes a tenth of the time of torch's.
    rows = torch.from_numpy(np.sort(keys.numpy(), 1)) if keys.is_cpu else keys.sort(1).values
    return (rows[:, 1:] != rows[:, :-1]).sum(1, keepdim=True) + 1
