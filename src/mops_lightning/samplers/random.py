"""Random sampling (RS), a baseline in the paper's tables."""

import torch
from torch import Tensor

from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import seeded_keys, seeded_order, smallest
from mops_lightning.types import SampleOutput


class RandomSampler(Sampler):
    """Choose input points uniformly, without replacement.

    Flexible and nested. The sample depends on the seed and the cloud only, see ``ordering``.

    Args:
        m: largest number of points to return.
        seed: determines the order in which points are chosen.

    Raises:
        UserError: ``m`` is not a whole number of at least 1.

    Examples:
        >>> import torch
        >>> from mops_lightning import RandomSampler
        >>> output = RandomSampler(m=8)(torch.rand(2, 64, 3))  # (B, N, 3)
        >>> output.points.shape, output.indices.shape  # (B, m, 3), (B, m)
        (torch.Size([2, 8, 3]), torch.Size([2, 8]))
    """

    flexible = True
    nested = True
    any_unit = True
    spreads = False

    def __init__(self, m: int, seed: int = 0) -> None:
        super().__init__(m)
        self.seed = seed

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with their indices, in random order."""
        keys = seeded_keys(points, self.seed)
        indices = smallest(keys, m)
        return SampleOutput(gather_points(points, indices), indices, {})

    def sample_weighted(self, points: Tensor, m: int, weight: Tensor) -> Tensor:
        """Draw without replacement, each time with probabilities in proportion to the weights.

        Efraimidis and Spirakis, "Weighted random sampling with a reservoir", Information Processing
        Letters 2006, as times of exponential clocks: ``torch.multinomial`` takes up to 2²⁴ points.
        """
        order = seeded_order(points, self.seed)
        return _drawn(order, m, weight, self.seed)

    def choose_rows(self, points: Tensor, m: int, weight: Tensor | None = None) -> Tensor:
        """Choose as ``sample`` and ``sample_weighted`` do, in any unit."""
        if weight is None:
            keys = seeded_keys(points, self.seed, in_sphere=True)
            return smallest(keys, m)
        order = seeded_order(points, self.seed, in_sphere=True)
        return _drawn(order, m, weight, self.seed)


def _drawn(order: Tensor, m: int, weight: Tensor, seed: int) -> Tensor:
    """Draw rows ``(B, m)`` by weights ``(B, N)``, from seeded orders ``(B, N)``."""
    generator = torch.Generator().manual_seed(seed)
    arrivals = torch.empty(order.shape[1], dtype=torch.float64)
    arrivals.exponential_(generator=generator)
    ordered_weight = weight.double().gather(1, order)
    times = arrivals.to(order.device) / ordered_weight
    first = times.argsort(1)[:, :m]
    return order.gather(1, first)
