"""Gaussian noise on test clouds (paper section "Robustness Analysis")."""

import torch
from torch import Tensor

from mops_lightning.data.clouds import Clouds
from mops_lightning.ops.points import coordinates, with_coordinates
from mops_lightning.seeding import generator

NOISE, TARGET_NOISE = 13, 14
"""Random streams of the noise."""


def noisy_clouds(clouds: Clouds, noise: float) -> Clouds:
    """Add noise to all clouds of a split, of pairs to both; see ``noisy``."""
    pairs = clouds.pairs
    if pairs is not None:
        pairs = pairs._replace(target=noisy(pairs.target, noise, TARGET_NOISE))
    return clouds._replace(points=noisy(clouds.points, noise), pairs=pairs)


def noisy(points: Tensor, noise: float, stream: int = NOISE) -> Tensor:
    """Add Gaussian noise to every coordinate, without clipping.

    The noise of a cloud depends on its position in the split only, so that every method is tested
    on the same noisy clouds. Other standard deviations scale the same noise.

    Args:
        points: ``(S, N, 3)`` clouds of a split, perhaps with attributes, which stay as they are.
        noise: standard deviation in units of the coordinates; 0.1 is 10 % in the paper.
        stream: of the random numbers.

    Returns:
        The points with noise.
    """
    if not noise:
        return points
    exact = coordinates(points)
    drawn = [
        torch.randn(exact.shape[1:], generator=generator(stream, s)) for s in range(len(exact))
    ]
    return with_coordinates(points, exact + noise * torch.stack(drawn))
