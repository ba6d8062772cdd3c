"""FMOPS-Net: one network for any number of points."""

from typing import Any, Literal

import torch

from mops_lightning.errors import UserError, check_at_least, did_you_mean
from mops_lightning.samplers.mops import MOPSNet

DISTRIBUTIONS = ("nested", "uniform")


class FMOPSNet(MOPSNet):
    """MOPS-Net whose left-most m columns of S are trained for every m.

    Paper section "Flexible MOPS-Net for Arbitrary Ratios".

    One net serves all 1 ≤ m ≤ m_max: the first m points of the largest sample are the sample of
    size m.

    Args:
        m_max: largest number of points.
        size_sampling: how a training step chooses its sizes. ``uniform`` draws one m from min_size
            to m_max, as in the paper; ``nested`` splits the range of logarithms into ``num_sizes``
            equal parts and draws one m from each. The sizes of a step share one forward pass of the
            sampler, and their losses are averaged.
        num_sizes: number of sizes with ``nested``.
        min_size: smallest training size, or m_max if that is smaller. Smaller samples can be taken,
            but are not trained for.
        **settings: arguments of ``MOPSNet``.

    Raises:
        UserError: an argument is out of range.

    Examples:
        >>> import torch
        >>> from mops_lightning import FMOPSNet
        >>> sampler = FMOPSNet(m_max=32).eval()
        >>> points = torch.rand(2, 64, 3)  # (B, N, 3)
        >>> sampler(points, m=5).points.shape, sampler(points, m=20).points.shape  # (B, m, 3)
        (torch.Size([2, 5, 3]), torch.Size([2, 20, 3]))
    """

    flexible = True
    nested = True

    def __init__(
        self,
        m_max: int = 512,
        size_sampling: Literal["nested", "uniform"] = "nested",
        num_sizes: int = 4,
        min_size: int = 1,
        **settings: Any,
    ) -> None:
        super().__init__(m_max, **settings)
        if size_sampling not in DISTRIBUTIONS:
            hint = did_you_mean(size_sampling, DISTRIBUTIONS)
            raise UserError(f"size_sampling: unknown {size_sampling!r}.{hint}")
        check_at_least(1, num_sizes=num_sizes, min_size=min_size)
        self.size_sampling = size_sampling
        self.num_sizes = num_sizes
        self.min_size = min_size

    def training_sizes(self) -> tuple[int, ...]:
        """Draw the sizes of one training step, ascending, from torch's global generator."""
        smallest = min(self.min_size, self.m)
        if self.size_sampling == "uniform":
            return (int(torch.randint(smallest, self.m + 1, ())),)
        parts = self.num_sizes
        exponents = (torch.arange(parts) + torch.rand(parts)).double() / parts
        # floor(a·((m_max + 1)/a)^u) ranges from a to m_max, with probabilities ∝ log(1 + 1/m).
        sizes = smallest * ((self.m + 1) / smallest) ** exponents
        return tuple(sizes.long().clamp(smallest, self.m).unique().tolist())
