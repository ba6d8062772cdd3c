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
        size_sampling: from which m a training step learns. ``uniform`` draws one m from 1 to m_max
            (the paper); ``log_uniform`` draws one whose logarithm is uniform, so that small sizes
            come as often as large ones; ``nested`` cuts the range of logarithms into ``num_sizes``
            equal parts and draws one m from each: they share one forward pass of the sampler, and
            the mean of their losses counts.
        num_sizes: how many sizes ``nested`` takes.
        **settings: as for ``MOPSNet``.

    Raises:
        UserError: a setting is out of its range.

    Example:
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
        size_sampling: Literal["nested", "uniform", "log_uniform"] = "nested",
        num_sizes: int = 4,
        **settings: Any,
    ) -> None:
        super().__init__(m_max, **settings)
        if size_sampling not in DISTRIBUTIONS:
            hint = did_you_mean(size_sampling, DISTRIBUTIONS)
            raise UserError(f"sampler.size_sampling: unknown {size_sampling!r}.{hint}")
        if num_sizes < 1:
            raise UserError(f"sampler.num_sizes must be at least 1, got {num_sizes}.")
        self.size_sampling = size_sampling
        self.num_sizes = num_sizes

    def training_sizes(self) -> tuple[int, ...]:
        """Draw the sizes of one training step, ascending, from torch's global generator."""
        if self.size_sampling == "uniform":
            return (int(torch.randint(1, self.m + 1, ())),)
        parts = self.num_sizes if self.size_sampling == "nested" else 1
        places = (torch.arange(parts) + torch.rand(parts)).double() / parts
        # floor((m_max + 1)^u) takes every m from 1 to m_max, m with a share of log(1 + 1/m).
        sizes = ((self.m + 1) ** places).floor().long().clamp(1, self.m)
        return tuple(sizes.unique().tolist())
