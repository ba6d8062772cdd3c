"""Base class of samplers that choose points by the normals of the surface."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.errors import check_at_least
from mops_lightning.ops.normals import NEIGHBOURS, estimate_normals
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_order
from mops_lightning.types import SampleOutput


class ByNormals(Sampler):
    """Base class of samplers that choose points by normals, of which the sign has no effect.

    Normals that are not given are estimated by planes through the nearest points. Flexible and
    nested. It runs on the CPU. A subclass implements ``choose``.

    Args:
        m: largest number of points to return.
        seed: of the order of the points (see ``ordering``), which breaks ties.
        neighbours: number of nearest points through which planes are fitted, from 3.

    Raises:
        UserError: an argument is out of range.
    """

    flexible = True
    nested = True
    spreads = False

    def __init__(self, m: int, seed: int = 0, neighbours: int = NEIGHBOURS) -> None:
        super().__init__(m)
        check_at_least(3, neighbours=neighbours)
        self.seed = seed
        self.neighbours = neighbours

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with their indices, in the order of choice."""
        indices = self.rows(points, m)
        return SampleOutput(gather_points(points, indices), indices, {})

    @torch.no_grad()
    def rows(self, points: Tensor, m: int, normals: Tensor | None = None) -> Tensor:
        """Return the rows ``(B, m)`` of the chosen points, in the order of choice.

        Args:
            points: ``(B, N, 3)``, finite.
            m: number of points, 1 ≤ m ≤ N.
            normals: ``(B, N, 3)`` unit vectors; None: they are estimated.
        """
        order = seeded_order(points, self.seed)
        ordered = gather_points(points.detach(), order)
        clouds = ordered.double().cpu().numpy()
        if normals is None:
            directions = [estimate_normals(cloud, self.neighbours) for cloud in clouds]
        else:
            ordered_normals = gather_points(normals, order)
            directions = list(ordered_normals.double().cpu().numpy())
        pairs = zip(clouds, directions, strict=True)
        places = [self.choose(cloud, direction, m) for cloud, direction in pairs]
        chosen = torch.from_numpy(np.stack(places)).to(points.device)
        return order.gather(1, chosen)

    def choose(
        self, points: NDArray[np.float64], normals: NDArray[np.float64], m: int
    ) -> NDArray[np.int64]:
        """Return the places ``(m,)`` of points ``(N, 3)`` with normals ``(N, 3)``."""
        raise NotImplementedError
