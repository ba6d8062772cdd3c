"""Noise on test clouds (paper section "Robustness Analysis")."""

import torch
from torch import Tensor

from mops_lightning.seeding import generator

NOISE = 13
"""Stream of random numbers of the noise."""


def noisy(points: Tensor, noise: float) -> Tensor:
    """Add Gaussian noise to every coordinate, without a bound.

    A cloud's noise depends on its place in the split only, so that every method is tested on the
    same noisy clouds, and more noise is the same noise, enlarged.

    Args:
        points: ``(S, N, 3)``, one cloud a row.
        noise: standard deviation in units of the coordinates; the paper's 10 % are 0.1.
    """
    if not noise:
        return points
    drawn = [
        torch.randn(points.shape[1:], generator=generator(NOISE, s)) for s in range(len(points))
    ]
    return points + noise * torch.stack(drawn)
