"""Poisson-disk sampling by sample elimination, with exactly m points."""

from torch import Tensor

from mops_lightning.ops.elimination import eliminate
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import SampleOutput


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
    seed and the cloud only. Flexible, but not nested. It runs on the CPU; time is proportional to
    the number of pairs of points that are nearer than d_max.

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
