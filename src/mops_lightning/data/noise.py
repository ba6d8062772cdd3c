"""Gaussian noise on test clouds (paper section "Robustness Analysis")."""

import torch
from torch import Tensor

from mops_lightning.seeding import generator

NOISE = 13
"""Random stream of the noise."""


def noisy(points: Tensor, noise: float) -> Tensor:
    """Add Gaussian noise to every coordinate, without clipping.

    The noise of a cloud depends on its position in the split only, so that every method is tested
    on the same noisy clouds. Other standard deviations scale the same noise.

    Args:
        points: ``(S, N, 3)`` clouds of a split.
        noise: standard deviation in units of the coordinates; 0.1 is 10 % in the paper.

    Returns:
        ``(S, N, 3)``.
    """
    if not noise:
        return points
    drawn = [
        torch.randn(points.shape[1:], generator=generator(NOISE, s)) for s in range(len(points))
    ]
    return points + noise * torch.stack(drawn)
