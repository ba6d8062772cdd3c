"""FMOPS-Net: one training, any number of points (paper section "Flexible MOPS-Net")."""

from typing import Any, Literal

import torch

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.samplers.mops import MOPSNet

DISTRIBUTIONS = ("nested", "uniform", "log_uniform")


class FMOPSNet(MOPSNet):
    """MOPS-Net whose left-most m columns of S are trained for every m.

    One net for 1 ≤ m ≤ m_max: the first m points of the largest sample are the sample of size m.

    Args:
        m_max: largest number of points.
        sizes_per_step: from which m a training step learns. ``uniform`` draws one m from 1 to m_max
            (the paper); ``log_uniform`` draws one whose logarithm is uniform, so that small sizes
            come as often as large ones; ``nested`` cuts the range of logarithms into ``prefixes``
            equal parts and draws one m from each: they share one forward pass of the sampler, and
            the mean of their losses counts.
        prefixes: how many sizes ``nested`` takes.
        **settings: as for ``MOPSNet``.

    Raises:
        UserError: a setting is out of its range.
    """

    flexible = True
    nested = True

    def __init__(
        self,
        m_max: int = 512,
        sizes_per_step: Literal["nested", "uniform", "log_uniform"] = "nested",
        prefixes: int = 4,
        **settings: Any,
    ) -> None:
        super().__init__(m_max, **settings)
        if sizes_per_step not in DISTRIBUTIONS:
            hint = did_you_mean(sizes_per_step, DISTRIBUTIONS)
            raise UserError(f"sampler.sizes_per_step: unknown {sizes_per_step!r}.{hint}")
        if prefixes < 1:
            raise UserError(f"sampler.prefixes must be at least 1, got {prefixes}.")
        self.sizes_per_step = sizes_per_step
        self.prefixes = prefixes

    def training_sizes(self) -> tuple[int, ...]:
        """Draw the sizes of one training step, ascending, from torch's global generator."""
        if self.sizes_per_step == "uniform":
            return (int(torch.randint(1, self.m + 1, ())),)
        parts = self.prefixes if self.sizes_per_step == "nested" else 1
        places = (torch.arange(parts) + torch.rand(parts)).double() / parts
        # floor((m_max + 1)^u) takes every m from 1 to m_max, m with a share of log(1 + 1/m).
        sizes = ((self.m + 1) ** places).floor().long().clamp(1, self.m)
        return tuple(sizes.unique().tolist())
