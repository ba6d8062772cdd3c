"""Losses."""

from torch import Tensor

from mops_lightning.geometry import nearest


def subset_loss(points: Tensor, samples: Tensor) -> Tensor:
    """Return the paper's L_subset, averaged over clouds."""
    return nearest(samples, points)[0].mean()
