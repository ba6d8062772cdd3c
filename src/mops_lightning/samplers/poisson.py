"""Poisson-disk sampling by sample elimination, with exactly m points.

Yuksel, "Sample Elimination for Generating Poisson Disk Sample Sets", Computer Graphics Forum 2015.
"""

import torch
from torch import Tensor

from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import SampleOutput

BLOCK = 2**22
"""Distances in memory at a time while the weights are summed."""


class PoissonSampler(Sampler):
    """Start from all points and remove the most crowded one until m points remain.

    The crowding of a point is Σ (1 − d/d_max)⁸ over the remaining points nearer than d_max. The
    publication computes d_max from the area of the surface, which is unknown for a cloud. Here,
    d_max is twice the distance at which farthest point sampling chooses its m-th point, an upper
    bound of the spacing of any m points of the cloud. The publication also has a lower bound for d,
    which is omitted here.

    The seeded order of the cloud (see ``ordering``) breaks ties, so that the sample depends on the
    seed and the cloud only. Flexible, but not nested. Takes O(N·(N − m)) time and O(N) memory.

    Args:
        m: largest number of points to return.
        seed: determines how ties are broken.

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
    batch, number, _ = points.shape
    # In double precision, rounding does not depend on how many numbers are added at once.
    points = points.double()
    reach = spacing_bound(points, m)
    crowding = _crowding(points, reach)
    planes = points.permute(2, 0, 1).contiguous()  # every step runs along memory
    for _ in range(number - m):
        worst = crowding.argmax(1, keepdim=True)
        removed = planes.gather(2, worst.expand(len(planes), -1, -1))
        crowding -= _weights((planes - removed).square_().sum(0), reach)
        crowding.scatter_(1, worst, -torch.inf)
    return (crowding > -torch.inf).nonzero()[:, 1].view(batch, m)


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


def _weights(squared: Tensor, reach: Tensor) -> Tensor:
    """Return weights of squared distances, in place: 1 at distance 0, and 0 from ``reach`` on."""
    tiny = torch.finfo(squared.dtype).tiny
    share = squared.sqrt_().div_(reach.clamp_min(tiny)).neg_().add_(1).clamp_min_(0)
    return share.square_().square_().square_()  # eighth power, as published


def _crowding(points: Tensor, reach: Tensor) -> Tensor:
    """Return the sum of the weights of all other points, ``(B, N)``, computed in blocks."""
    batch, number, _ = points.shape
    total = torch.empty(batch, number, dtype=points.dtype, device=points.device)
    height = max(1, BLOCK // number)
    for cloud in range(batch):
        for start in range(0, number, height):
            part = points[cloud, start : start + height]
            squared = (part[:, None] - points[cloud]).square().sum(2)
            total[cloud, start : start + height] = _weights(squared, reach[cloud]).sum(1)
    return total - 1  # the weight of the point itself
