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
"""Distances held at once while the weights are summed."""


class PoissonSampler(Sampler):
    """Start from all points and drop the most crowded one until m are left.

    A point's crowding is Σ (1 − d/d_max)⁸ over the others that are still there and nearer than
    d_max. The publication takes d_max from the area of the surface, which a cloud does not tell;
    here it is twice the distance at which farthest point sampling takes its m-th point, the
    smallest number that is known to bound the spacing of any m points of the cloud. The publication
    also weighs points nearer than a lower bound as if they stood at it, which is left out here.

    Ties follow the seeded order of the cloud (see ``ordering``), so the choice does not change with
    batch, call or order of the points. Flexible: any m up to the given one, but not nested. Takes
    time proportional to N·(N − m) and memory to N.

    Args:
        m: largest number of points to return.
        seed: another seed decides ties in another way.

    Example:
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
    """Drop the most crowded point of every cloud, again and again; see ``PoissonSampler``.

    Args:
        points: ``(B, N, C)``; of equally crowded points the first is dropped.
        m: how many stay, 1 ≤ m ≤ N.

    Returns:
        ``(B, m)`` int64 rows of ``points``, ascending.
    """
    batch, number, _ = points.shape
    # Double precision: sums must not depend on how many numbers are added at once.
    points = points.double()
    reach = spacing_bound(points, m)
    crowding = _crowding(points, reach)
    planes = points.permute(2, 0, 1).contiguous()  # so that every step runs along memory
    for _ in range(number - m):
        worst = crowding.argmax(1, keepdim=True)
        dropped = planes.gather(2, worst.expand(len(planes), -1, -1))
        crowding -= _weights((planes - dropped).square_().sum(0), reach)
        crowding.scatter_(1, worst, -torch.inf)
    return (crowding > -torch.inf).nonzero()[:, 1].view(batch, m)


def spacing_bound(points: Tensor, m: int) -> Tensor:
    """Return ``(B, 1)``: no m points of the cloud are all farther apart than this.

    Each of m such points would have to lie within half of it of one of the m − 1 points that
    farthest point sampling takes first, so two would share one.
    """
    if m == 1:
        spans = points.amax(1) - points.amin(1)
        return torch.linalg.vector_norm(spans, dim=1, keepdim=True)
    chosen = gather_points(points, farthest_point_sample(points, m))
    last = torch.linalg.vector_norm(chosen[:, :-1] - chosen[:, -1:], dim=2)
    return 2 * last.amin(1, keepdim=True)


def _weights(squared: Tensor, reach: Tensor) -> Tensor:
    """Weigh squared distances, which are overwritten: 1 at 0, falling to 0 at ``reach``."""
    tiny = torch.finfo(squared.dtype).tiny
    share = squared.sqrt_().div_(reach.clamp_min(tiny)).neg_().add_(1).clamp_min_(0)
    return share.square_().square_().square_()  # to the eighth, as published


def _crowding(points: Tensor, reach: Tensor) -> Tensor:
    """Sum the weights of all other points for every point, ``(B, N)``, block by block."""
    batch, number, _ = points.shape
    total = torch.empty(batch, number, dtype=points.dtype, device=points.device)
    height = max(1, BLOCK // number)
    for cloud in range(batch):
        for start in range(0, number, height):
            part = points[cloud, start : start + height]
            squared = (part[:, None] - points[cloud]).square().sum(2)
            total[cloud, start : start + height] = _weights(squared, reach[cloud]).sum(1)
    return total - 1  # each point weighed itself
