"""Clouds on which fast and plain forms could differ."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F


def cloud_of(
    kind: str, shape: tuple[int, int], dtype: torch.dtype, rng: torch.Generator
) -> torch.Tensor:
    """Return clouds ``(B, N, 3)`` of a kind; normally distributed if the kind is unknown."""
    number = shape[1]
    points = torch.randn(*shape, 3, dtype=dtype, generator=rng)
    if kind == "sphere":
        points = F.normalize(points, dim=2)
    if kind == "grid":  # many ties
        points = points.mul(3).round()
    if kind == "line":
        points[..., 1:] = 0
    if kind == "copies":
        points[:, number // 2 :] = points[:, : number - number // 2]
    if kind == "one point":
        points[:] = 0.25
    if kind == "offset":
        points = points + 1000
    if kind == "tiny":
        points = points * torch.finfo(dtype).tiny
    if kind == "huge":  # squares of differences overflow, and some differences
        points = points.clamp(-3, 3) / 3 * torch.finfo(dtype).max
    if kind == "outlier":
        points[:, 0] = 1e6
    return points


def line_of(number: int) -> NDArray[np.float64]:
    """Return points ``(N, 3)`` at distances of 1 along x."""
    line = np.zeros((number, 3))
    line[:, 0] = np.arange(number)
    return line


def normal_points(number: int, seed: int) -> NDArray[np.float64]:
    """Return normally distributed points ``(N, 3)``."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(number, 3))


def uniform_points(number: int, seed: int) -> NDArray[np.float64]:
    """Return points ``(N, 3)`` spread evenly over the unit cube."""
    rng = np.random.default_rng(seed)
    return rng.random((number, 3))
