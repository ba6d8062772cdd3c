"""Poisson-disk sampling by sample elimination, with exactly m points.

The compiled loops visit the points of neighbouring cells only. They run on the CPU, for clouds on
other devices, too.
"""

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.ops import kernel_elimination
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import SampleOutput

FINEST = 2**20
"""Maximum number of cells along an axis: three positions fit into an integer of 64 bits."""


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
    shares = None if weight is None else weight.gather(1, order)
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
    points = points.double()
    reach = spacing_bound(points, m).clamp_min(torch.finfo(points.dtype).tiny)
    # Sums of integers do not depend on the order of the points.
    scale = 2.0 ** min(50, 62 - number.bit_length())
    shares = np.empty((len(points), 0))
    if weight is not None:
        shares = (weight.double().amin(1, keepdim=True) / weight.double()).cpu().numpy()
    clouds = zip(points.cpu().numpy(), reach.flatten().tolist(), shares, strict=True)
    remaining = [
        _eliminate_by_cells(cloud, m, bound, share, scale) for cloud, bound, share in clouds
    ]
    rows = [torch.from_numpy(np.flatnonzero(remains)) for remains in remaining]
    return torch.stack(rows).to(points.device)


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


def _eliminate_by_cells(
    points: NDArray[np.float64], m: int, reach: float, shares: NDArray[np.float64], scale: float
) -> NDArray[np.bool_]:
    """Return whether each of ``(N, C)`` points remains, by the compiled loops."""
    points = np.pad(points, ((0, 0), (0, max(3 - points.shape[1], 0))))
    coordinates = points[:, :3]  # points that are near are near in these, too
    low = coordinates.min(0)
    extent = float((coordinates.max(0) - low).max())
    side = max(reach, extent / FINEST) * (1 + 1e-9)
    position = ((coordinates - low) / side).astype(np.int64) + 1  # no neighbour is below 0
    key = (position[:, 0] * 2 * FINEST + position[:, 1]) * 2 * FINEST + position[:, 2]
    order = key.argsort(kind="stable")
    ordered = key[order]
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    cells = ordered[starts]
    around = np.empty((len(cells), 27), np.int32)
    for column, (x, y, z) in enumerate(itertools.product((-1, 0, 1), repeat=3)):
        wanted = cells + ((x * 2 * FINEST + y) * 2 * FINEST + z)
        place = np.minimum(np.searchsorted(cells, wanted), len(cells) - 1)
        around[:, column] = np.where(cells[place] == wanted, place, -1)
    remains: NDArray[np.bool_] = kernel_elimination.eliminate(
        np.ascontiguousarray(points[order].T).ravel(),
        order,
        np.append(starts, len(points)),
        around.ravel(),
        shares[order] if len(shares) else shares,
        m,
        reach,
        scale,
    )
    return remains
