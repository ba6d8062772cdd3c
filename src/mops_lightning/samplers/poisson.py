"""Poisson-disk sampling by sample elimination, with exactly m points.

Yuksel, "Sample Elimination for Generating Poisson Disk Sample Sets", Computer Graphics Forum 2015.
"""

import torch
from torch import Tensor

from mops_lightning.ops.elimination import eliminate_by_cells
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import SampleOutput

BLOCK = 2**22
"""Distances in memory at a time while the weights are summed."""


class PoissonSampler(Sampler):
    """Start from all points and remove the most crowded one until m points remain.

    Yuksel, "Sample Elimination for Generating Poisson Disk Sample Sets", Computer Graphics Forum
    2015.

    The crowding of a point is Σ (1 − d/d_max)⁸ over the remaining points nearer than d_max. The
    publication computes d_max from the area of the surface, which is unknown for a cloud. Here,
    d_max is twice the distance at which farthest point sampling chooses its m-th point, an upper
    bound of the spacing of any m points of the cloud. The publication also has a lower bound for d,
    which is omitted here.

    The seeded order of the cloud (see ``ordering``) breaks ties, so that the sample depends on the
    seed and the cloud only. Flexible, but not nested. Takes O(N·(N − m)) time and O(N) memory; with
    numba (``pip install 'mops-lightning[fast]'``), time proportional to the number of pairs of
    points that are nearer than d_max, with the same result.

    Args:
        m: largest number of points to return.
        seed: determines how ties are broken.

    Raises:
        UserError: ``m`` is not a whole number of at least 1.

    Examples:
        >>> import torch
        >>> from mops_lightning import PoissonSampler
        >>> output = PoissonSampler(m=8)(torch.rand(2, 64, 3))  # (B, N, 3)
        >>> output.points.shape, output.indices.shape  # (B, m, 3), (B, m)
        (torch.Size([2, 8, 3]), torch.Size([2, 8]))
    """

    flexible = True

    def __init__(self, m: int, seed: int = 0) -> None:
        super().__init__(m)
        self.seed = seed

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with their indices, in seeded order."""
        order = seeded_order(points, self.seed)
        kept = eliminate(gather_points(points.detach(), order), m)
        indices = order.gather(1, kept)
        return SampleOutput(gather_points(points, indices), indices, {})


@torch.no_grad()
def eliminate(points: Tensor, m: int) -> Tensor:
    """Remove the most crowded point of every cloud until m remain; see ``PoissonSampler``.

    Args:
        points: ``(B, N, C)``; the first point is removed in case of ties.
        m: number of points that remain, 1 ≤ m ≤ N.

    Returns:
        ``(B, m)`` int64 rows of ``points``, ascending.
    """
    number = points.shape[1]
    points = points.double()
    reach = spacing_bound(points, m).clamp_min(torch.finfo(points.dtype).tiny)
    # Sums of integers do not depend on the order of the points.
    scale = 2.0 ** min(50, 62 - number.bit_length())
    rows = _compiled(points, m, reach, scale)
    return _plain(points, m, reach, scale) if rows is None else rows


def _compiled(points: Tensor, m: int, reach: Tensor, scale: float) -> Tensor | None:
    """Return the rows ``(B, m)`` that remain; None where the plain form must be used."""
    rows = []
    for cloud, bound in zip(points, reach.flatten().tolist(), strict=True):
        row = eliminate_by_cells(cloud, m, bound, scale)
        if row is None:
            return None
        rows.append(row)
    return torch.stack(rows) if rows else None


def _plain(points: Tensor, m: int, reach: Tensor, scale: float) -> Tensor:
    """Return the rows ``(B, m)`` that remain, from the distances to all points in every step."""
    batch, number, _ = points.shape
    planes = points.permute(2, 0, 1).contiguous()  # every step runs along memory
    crowding = _crowding(planes, reach, scale)
    for _ in range(number - m):
        worst = crowding.argmax(1, keepdim=True)
        removed = planes.gather(2, worst.expand(len(planes), -1, -1))
        crowding -= _weights(planes - removed, reach, scale)
        crowding.scatter_(1, worst, -1)
    return (crowding > 0).nonzero()[:, 1].view(batch, m)


def spacing_bound(points: Tensor, m: int) -> Tensor:
    """Return an upper bound of the smallest distance among any m points of a cloud.

    Every point is within half of this bound of one of the first m − 1 points of farthest point
    sampling. Of any m points, two therefore share the same one.

    Args:
        points: ``(B, N, C)``.
        m: number of points.

    Returns:
        ``(B, 1)``.
    """
    if m == 1:
        spans = points.amax(1) - points.amin(1)
        return torch.linalg.vector_norm(spans, dim=1, keepdim=True)
    chosen = gather_points(points, farthest_point_sample(points, m))
    last = torch.linalg.vector_norm(chosen[:, :-1] - chosen[:, -1:], dim=2)
    return 2 * last.amin(1, keepdim=True)


def _weights(differences: Tensor, reach: Tensor, scale: float) -> Tensor:
    """Return weights of differences ``(C, ...)``: ``scale`` at 0, and 0 from ``reach`` on; int64.

    Changes the differences.
    """
    squared, *others = differences.square_().unbind(0)
    for other in others:
        squared += other
    share = squared.sqrt_().div_(reach).neg_().add_(1).clamp_min_(0)
    # Eighth power, as published.
    return share.square_().square_().square_().mul_(scale).long()


def _crowding(planes: Tensor, reach: Tensor, scale: float) -> Tensor:
    """Return the sum of the weights of all points, ``(B, N)`` int64, computed in blocks."""
    _, batch, number = planes.shape
    total = torch.empty(batch, number, dtype=torch.int64, device=planes.device)
    height = max(1, BLOCK // number)
    for cloud in range(batch):
        for start in range(0, number, height):
            part = planes[:, cloud, start : start + height, None]
            weights = _weights(planes[:, cloud, None] - part, reach[cloud], scale)
            total[cloud, start : start + height] = weights.sum(1)
    return total
