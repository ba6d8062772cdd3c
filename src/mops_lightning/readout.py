"""Readouts."""

from torch import Tensor

from mops_lightning.geometry import nearest


def match(generated: Tensor, points: Tensor) -> Tensor:
    """Return the index of the nearest input point of each generated one."""
    return nearest(generated, points)[1]


def unique_count(indices: Tensor) -> Tensor:
    """Return the number of different indices per row."""
    ordered = indices.sort(1).values
    return 1 + (ordered[:, 1:] != ordered[:, :-1]).sum(1)


def complete(indices: Tensor, points: Tensor) -> Tensor:
    """Fill up by farthest point sampling."""
    raise NotImplementedError
