"""Poisson-disk sampling by sample elimination, with exactly m points.

The compiled loops visit neighbouring blocks of points only. They run on the CPU, for clouds on
other devices, too.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.ops import kernel_elimination
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.samplers.serial import morton_codes
from mops_lightning.types import SampleOutput

SMALLEST = 2.3e-308
"""Above the least normal number."""


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
    any_unit = True

    def __init__(self, m: int, seed: int = 0) -> None:
        super().__init__(m)
        self.seed = seed

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with their indices, in seeded order."""
        indices = poisson_rows(points, m, self.seed)
        return SampleOutput(gather_points(points, indices), indices, {})

    def sample_weighted(self, points: Tensor, m: int, weight: Tensor) -> Tensor:
        """Divide the crowding of every point by its weight, which the publication does not do."""
        return poisson_rows(points, m, self.seed, weight)

    def choose_rows(self, points: Tensor, m: int, weight: Tensor | None = None) -> Tensor:
        """Choose as ``sample`` and ``sample_weighted`` do, in any unit."""
        return poisson_rows(points, m, self.seed, weight, in_sphere=True)


def poisson_rows(
    points: Tensor,
    m: int,
    seed: int = 0,
    weight: Tensor | None = None,
    in_sphere: bool = False,
) -> Tensor:
    """Return the rows ``(B, m)`` that sample elimination keeps, in seeded order.

    Args:
        points: ``(B, N, C)``, finite.
        m: number of points that remain, 1 ≤ m ≤ N.
        seed: determines how ties are broken.
        weight: ``(B, N)`` as for ``eliminate``.
        in_sphere: take the order of the clouds in the unit sphere; see ``ops.keys.SeededOrder``.
    """
    order = seeded_order(points, seed, in_sphere)
    ordered = gather_points(points.detach(), order)
    shares = None
    if weight is not None:
        shares = weight.gather(1, order)
    return order.gather(1, eliminate(ordered, m, shares))


@torch.no_grad()
def eliminate(points: Tensor, m: int, weight: Tensor | None = None) -> Tensor:
    """Remove the most crowded point of every cloud until m remain; see ``PoissonSampler``.

    Args:
        points: ``(B, N, C)``, finite; the first point is removed in case of ties.
        m: number of points that remain, 1 ≤ m ≤ N.
        weight: ``(B, N)``, above 0: the crowding of a point is divided by its weight.

    Returns:
        ``(B, m)`` int64 rows of ``points``, ascending.
    """
    number = points.shape[1]
    tiny = torch.finfo(torch.float64).tiny
    reach = spacing_bound(points, m).clamp_min(tiny)
    # Sums of integers do not depend on the order of the points.
    scale = 2.0 ** min(50, 62 - number.bit_length())
    shares = np.empty((len(points), 0))
    if weight is not None:
        exact = weight.double()
        relative = exact.amin(1, keepdim=True) / exact
        shares = relative.cpu().numpy()
    remaining = []
    arrays = points.double().cpu().numpy()
    bounds = reach.flatten().tolist()
    for cloud, bound, share in zip(arrays, bounds, shares, strict=True):
        remaining.append(_least_crowded(cloud, m, bound, share, scale))
    return torch.from_numpy(np.stack(remaining)).to(points.device)


def spacing_bound(points: Tensor, m: int) -> Tensor:
    """Return an upper bound of the smallest distance among any m points of a cloud.

    Every point is within half of this bound of one of the first m − 1 points of farthest point
    sampling. Of any m points, two therefore share the same one.

    Args:
        points: ``(B, N, C)``.
        m: number of points.

    Returns:
        ``(B, 1)`` float64.
    """
    if m == 1:
        exact = points.double()
        spans = exact.amax(1) - exact.amin(1)
        return torch.linalg.vector_norm(spans, dim=1, keepdim=True)
    rows = farthest_point_sample(points, m)
    chosen = gather_points(points, rows).double()
    to_last = chosen[:, :-1] - chosen[:, -1:]
    distances = torch.linalg.vector_norm(to_last, dim=2)
    return 2 * distances.amin(1, keepdim=True)


def _least_crowded(
    points: NDArray[np.float64],
    m: int,
    reach: float,
    shares: NDArray[np.float64],
    scale: float,
) -> NDArray[np.int64]:
    """Return the m rows of ``(N, C)`` points that remain, ascending."""
    missing_axes = max(3 - points.shape[1], 0)
    padded = np.pad(points, ((0, 0), (0, missing_axes)))
    coordinates = torch.from_numpy(padded[None, :, :3])
    order = np.argsort(morton_codes(coordinates)[0].numpy())
    if len(shares):
        shares = shares[order]
    farthest = reach * (1 - scale**-0.125)  # from here on, weights are less than 1
    limit = farthest * farthest * (1 + 1e-9) + SMALLEST
    rows = kernel_elimination.eliminate(
        np.ascontiguousarray(padded[order].T).ravel(),
        padded.shape[1],
        order,
        shares,
        m,
        limit,
        1 / reach,
        scale,
    )
    return np.sort(rows)
