"""Voxel sampling with exactly m points, a baseline in the paper's tables."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.ops import voxel_search
from mops_lightning.ops.fps import farthest_point_fill
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import point_hashes, seeded_order
from mops_lightning.types import SampleOutput

COARSEST, FINEST = -1.0, 20.0
"""Range of log₂(side of the cloud / side of a voxel): one voxel, and the precision of float32."""
BISECTIONS = 24
"""Bisection steps; the relative error of the voxel size is about one in a million."""
SORTING_STEPS = (5, 11)
"""Bisection steps before which the points are sorted by voxels."""


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
        counts = torch.tensor([len(chosen) for chosen in fullest], device=points.device)
        if int(counts.min()) < m:
            indices = _filled(detached, indices, counts)
        return SampleOutput(gather_points(points, indices), indices, {})


def _filled(points: Tensor, indices: Tensor, counts: Tensor) -> Tensor:
    """Fill up by farthest point sampling, whose ties do not depend on the input order."""
    order = seeded_order(points, seed=0)
    places = torch.empty_like(order).scatter_(
        1, order, torch.arange(points.shape[1], device=points.device).expand_as(order)
    )
    filled = farthest_point_fill(gather_points(points, order), places.gather(1, indices), counts)
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
    spans = _spans(points)
    hashes = point_hashes(points, 0).cpu().numpy()
    scales = _scales(spans, m)
    exact = points.double().cpu().numpy()
    return [_fullest(*cloud) for cloud in zip(exact, spans, scales, hashes, strict=True)]


def _fullest(
    points: NDArray[np.float64],
    spans: NDArray[np.floating],
    scale: np.floating,
    hashes: NDArray[np.int64],
) -> NDArray[np.int64]:
    cell_of, keys = voxel_search.group(spans.ravel(), scale)
    bits = 61 - len(points).bit_length()
    counts, rows = voxel_search.nearest_to_means(
        np.ascontiguousarray(points).ravel(), cell_of, len(keys), hashes, bits
    )
    fullest: NDArray[np.int64] = rows[np.lexsort((keys, -counts))]
    return fullest


def _spans(points: Tensor) -> NDArray[np.floating]:
    """Return the ``(B, N, 3)`` positions of points in the unit cubes around their clouds."""
    exact = points.to(torch.promote_types(points.dtype, torch.float32))
    spans = exact - exact.amin(1, keepdim=True)
    side = spans.amax(1, keepdim=True).amax(2, keepdim=True)
    positions = spans / side.clamp_min(torch.finfo(spans.dtype).tiny)
    array: NDArray[np.floating] = positions.contiguous().cpu().numpy()
    return array


def _scales(spans: NDArray[np.floating], m: int) -> NDArray[np.floating]:
    """Return the smallest number of voxels per side with at least m occupied voxels."""
    coarse = torch.from_numpy(np.full(len(spans), COARSEST, spans.dtype))
    fine = torch.from_numpy(np.full(len(spans), FINEST, spans.dtype))
    clouds = [cloud.ravel() for cloud in spans]
    for step in range(BISECTIONS):
        middle = (coarse + fine) / 2
        scales = middle.exp2().numpy()
        if step in SORTING_STEPS:
            clouds = [_sorted(*pair) for pair in zip(clouds, scales, strict=True)]
        enough = torch.tensor(
            [voxel_search.reaches(*pair, m) for pair in zip(clouds, scales, strict=True)],
            device=coarse.device,
        )
        fine = torch.where(enough, middle, fine)
        coarse = torch.where(enough, coarse, middle)
    finest: NDArray[np.floating] = fine.exp2().numpy()
    return finest


def _sorted(spans: NDArray[np.floating], scale: np.floating) -> NDArray[np.floating]:
    """Sort positions by voxels of about the final size: they are then counted faster."""
    cell_of, keys = voxel_search.group(spans, scale)
    ordered: NDArray[np.floating] = voxel_search.sort_by_cell(spans, cell_of, len(keys))
    return ordered
