"""The best of several samplers for each number of points."""

from bisect import bisect_left
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from mops_lightning.channels import PointChannels
from mops_lightning.errors import UserError
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.types import SampleOutput

MOST = 2**31 - 1
"""Largest number of points to keep."""


class ByBudget(Sampler):
    """Choose input points by the method that a comparison found best for their number.

    Between two compared numbers of points with different methods, and above the largest one,
    farthest points are chosen. The same holds for numbers that the best method does not return.
    A trained sampler's points are completed sets. Flexible; nothing in it is trained.

    Args:
        budgets: numbers of points that were compared, ascending.
        best: for each of them, the position of its method in ``samplers``.
        samplers: the methods. The first one is farthest point sampling.
        point_channels: channels of the trained samplers, or their number.

    Raises:
        UserError: the arguments do not fit each other.

    Examples:
        >>> import torch
        >>> from mops_lightning import FPSSampler, PoissonSampler
        >>> from mops_lightning.samplers.by_budget import MOST, ByBudget
        >>> both = ByBudget([8, 16], [1, 0], [FPSSampler(MOST), PoissonSampler(MOST)])
        >>> both(torch.rand(2, 64, 3), 8).indices.shape  # by the second method
        torch.Size([2, 8])
    """

    flexible = True

    def __init__(
        self,
        budgets: Sequence[int],
        best: Sequence[int],
        samplers: Sequence[Sampler],
        point_channels: PointChannels | int = 0,
    ) -> None:
        super().__init__(MOST)
        self.point_channels = PointChannels.of(point_channels)
        if not samplers or not isinstance(samplers[0], FPSSampler):
            raise UserError("samplers must begin with farthest point sampling.")
        is_ascending = list(budgets) == sorted(set(budgets))
        are_pairs = len(budgets) == len(best)
        if not budgets or not are_pairs or not is_ascending or budgets[0] < 1:
            raise UserError("budgets must be ascending numbers of points, each with its best.")
        if not all(0 <= place < len(samplers) for place in best):
            raise UserError("best must hold positions in samplers.")
        self.budgets = tuple(budgets)
        self.best = tuple(best)
        self.samplers = nn.ModuleList(samplers)

    def sampler_for(self, m: int) -> Sampler:
        """Return the sampler that chooses m points."""
        sampler = cast(Sampler, self.samplers[self._place(m)])
        if sampler.flexible:
            can_sample = m <= sampler.m
        else:
            can_sample = m == sampler.m
        if can_sample:
            return sampler
        return cast(Sampler, self.samplers[0])

    def _place(self, m: int) -> int:
        """Return the position of the best method for m points."""
        after = bisect_left(self.budgets, m)
        if after == len(self.budgets):
            return 0
        is_compared = self.budgets[after] == m
        if is_compared or after == 0:
            return self.best[after]
        if self.best[after - 1] == self.best[after]:
            return self.best[after]
        return 0

    @torch.no_grad()
    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with their indices."""
        sampler = self.sampler_for(m)
        rows = rows_in_unit_sphere(sampler, sampler.seen_of(points), m)
        return SampleOutput(gather_points(points, rows), rows, {})


def rows_in_unit_sphere(sampler: Sampler, clouds: Tensor, m: int) -> Tensor:
    """Return the rows ``(B, m)`` of different points, of generated ones those of completed sets.

    Args:
        sampler: in evaluation mode.
        clouds: ``(B, N, 3 + C)`` in the unit sphere, with the channels that the sampler takes.
        m: number of points.
    """
    if sampler.generates:
        rows = sampler.select("completed", clouds, m)[1]
    else:
        rows = sampler(clouds, m).indices
    assert rows is not None  # completed sets are rows
    return rows
