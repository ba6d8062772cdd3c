"""Voxel sampling with exactly m points, a baseline in the paper's tables."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.ops import voxel_search
from mops_lightning.ops.fps import farthest_point_fill
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_hashes, seeded_order
from mops_lightning.types import SampleOutput

COARSEST = -1.0
FINEST = 20.0
"""Range of log₂(side of the cloud / side of a voxel): one voxel, and the precision of float32."""
BISECTIONS = 24
"""Bisection steps; the relative error of the voxel size is about one in a million."""
SETTLED = 0.25
"""Difference of two scales between which most positions stay in their voxels."""

Positions = NDArray[np.floating]
"""Coordinates in a unit cube, one point after the other."""


class VoxelSampler(Sampler):
    """Divide space into cubic voxels and return one input point for each of m occupied voxels.

    The point of a voxel is the one nearest to the mean of its points. The grid starts at the lowest
    corner of the cloud's bounding box. Bisection finds the largest voxel size of each cloud with at
    least m occupied voxels; where the number of voxels is not monotonic in the size, it finds one
    of several such sizes. The m voxels with the most points are kept and returned in this order;
    ties are broken in (x, y, z) order. If there are fewer than m voxels at the smallest size, 2⁻²⁰
    of the cloud's longest side, because points coincide, farthest point sampling adds input points.
    Flexible, but not nested. It runs on the CPU.

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
        detached = points.detach()
        fullest = [chosen[:m] for chosen in fullest_voxels(detached, m)]
        rows = np.zeros((len(points), m), np.int64)
        for row, chosen in zip(rows, fullest, strict=True):
            row[: len(chosen)] = chosen
        indices = torch.from_numpy(rows).to(points.device)
        numbers = [len(chosen) for chosen in fullest]
        counts = torch.tensor(numbers, device=points.device)
        if int(counts.min()) < m:
            indices = _filled(detached, indices, counts)
        return SampleOutput(gather_points(points, indices), indices, {})


def _filled(points: Tensor, indices: Tensor, counts: Tensor) -> Tensor:
    """Fill up by farthest point sampling, whose ties do not depend on the input order."""
    order = seeded_order(points, seed=0)
    numbers = torch.arange(points.shape[1], device=points.device)
    places = torch.empty_like(order).scatter_(1, order, numbers.expand_as(order))
    ordered = gather_points(points, order)
    filled = farthest_point_fill(ordered, places.gather(1, indices), counts)
    return order.gather(1, filled)


def fullest_voxels(points: Tensor, m: int) -> list[NDArray[np.int64]]:
    """Return the rows of the points nearest to the means of the voxels of the largest size.

    Args:
        points: ``(B, N, 3)``; of points that are equally near, the one with the lowest hash.
        m: smallest number of occupied voxels, 1 ≤ m ≤ N; there are fewer only if the smallest size
            gives fewer.

    Returns:
        For every cloud one row for each occupied voxel, in the order of descending numbers of
        points, then of ascending (x, y, z).
    """
    on_cpu = points.detach().cpu()
    exact = on_cpu.double().contiguous().numpy()
    hashes = seeded_hashes(on_cpu, 0).numpy()
    spans = _spans(on_cpu)
    scales = [_scale(cloud, m) for cloud in spans]
    clouds = zip(exact, spans, scales, hashes, strict=True)
    return [_fullest(*cloud) for cloud in clouds]


def _fullest(
    points: NDArray[np.float64],
    spans: Positions,
    scale: np.floating,
    hashes: NDArray[np.int64],
) -> NDArray[np.int64]:
    cell_of, keys = voxel_search.group(spans, scale)
    bits = 61 - len(points).bit_length()
    counts, rows = voxel_search.nearest_to_means(points.ravel(), cell_of, len(keys), hashes, bits)
    order = np.lexsort((keys, -counts))
    fullest: NDArray[np.int64] = rows[order]
    return fullest


def _spans(points: Tensor) -> list[Positions]:
    """Return the positions ``(3·N,)`` of the points of every cloud in the unit cube around it."""
    dtype = torch.promote_types(points.dtype, torch.float32)
    exact = points.to(dtype).contiguous().numpy()
    tiny = np.finfo(exact.dtype).tiny
    return [voxel_search.in_unit_cube(cloud.ravel(), tiny) for cloud in exact]


def _scale(spans: Positions, m: int) -> np.floating:
    """Return the smallest number of voxels per side with at least m occupied voxels.

    Args:
        spans: ``(3·N,)`` positions of a cloud in the unit cube.
        m: smallest number of voxels.
    """
    search = _Search(spans, m)
    coarse = spans.dtype.type(COARSEST)
    fine = spans.dtype.type(FINEST)
    for _ in range(BISECTIONS):
        middle = (coarse + fine) / 2
        if search.reaches(_power_of_two(middle)):
            fine = middle
        else:
            coarse = middle
    return _power_of_two(fine)


def _power_of_two(exponent: np.floating) -> np.floating:
    """Return 2ˣ as torch rounds it, which differs from NumPy's in the last bit."""
    powers = torch.from_numpy(np.array([exponent])).exp2_().numpy()
    power: np.floating = powers[0]
    return power


class _Search:
    """Counts the occupied voxels of one cloud at the scales of a bisection.

    Between two scales that differ little, most positions stay in their voxels. These voxels are
    counted once, and those of the other positions at every step.

    Args:
        spans: ``(3·N,)`` positions in the unit cube.
        m: smallest number of voxels.
    """

    def __init__(self, spans: Positions, m: int) -> None:
        bits = max((4 * m).bit_length(), 10)
        self.m = m
        self.moving = spans
        self.settled = np.full(2**bits, -1, np.int64)
        self.shift = 64 - bits
        self.wanted = m
        self.coarse = spans.dtype.type(0)
        self.fine = spans.dtype.type(2.0**FINEST)

    def reaches(self, scale: np.floating) -> bool:
        """Return whether at least m voxels are occupied; the answer bounds all later scales."""
        is_enough = self._is_enough(scale)
        if is_enough:
            self.fine = scale
        else:
            self.coarse = scale
        if self.fine - self.coarse < SETTLED:
            self._settle()
        return is_enough

    def _is_enough(self, scale: np.floating) -> bool:
        voxels_of_cube = (int(scale) + 1) ** 3
        if voxels_of_cube < self.m:
            return False
        has_wanted = voxel_search.reaches(self.moving, scale, self.wanted, self.settled, self.shift)
        return bool(has_wanted)

    def _settle(self) -> None:
        self.moving, entered = voxel_search.settle(
            self.moving, self.coarse, self.fine, self.settled, self.shift
        )
        self.wanted -= entered
