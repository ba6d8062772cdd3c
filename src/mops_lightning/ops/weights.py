"""Weights of points: checked, or computed as the curvature of the surface."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.points import as_tensor

CURVATURE = "curvature"
"""The word that asks for ``curvature`` in place of weights."""

NEIGHBOURS = 16
LEAST = 0.001
"""Nearest points of a plane fit, and the weight of a flat neighbourhood."""

PART = 2**16
"""Number of points whose neighbourhoods are in memory at a time."""


def check_weight(weight: Any, shape: tuple[int, ...], name: str = "weight") -> Tensor:
    """Return weights as float64.

    Args:
        weight: a tensor or an array, finite and at least 0.
        shape: the shape that it must have.
        name: of the argument, for errors.

    Raises:
        UserError: the shape or a value is wrong.
    """
    tensor = as_tensor(name, weight).detach()
    given = tuple(tensor.shape)
    if given != shape or tensor.is_complex():
        raise UserError(
            f"{name} must be one number per point, shape {shape}, got {tensor.dtype} of shape "
            f"{given}."
        )
    tensor = tensor.double()
    wrong = ~(torch.isfinite(tensor) & (tensor >= 0))
    if bool(wrong.any()):
        row = wrong.nonzero()[0]
        number = float(tensor[tuple(row)])
        row_text = ", ".join(map(str, row.tolist()))
        raise UserError(f"{name} must be finite and at least 0, got {number} in row {row_text}.")
    return tensor


def check_positive(number: int, m: int, name: str = "weight") -> None:
    """Reject fewer points of positive weight than are to be kept."""
    if number < m:
        raise UserError(f"{name}: {number} points have a weight above 0, fewer than m={m}.")


def curvature(points: NDArray[Any]) -> NDArray[np.float64]:
    """Return the surface variation λ₀ / (λ₀ + λ₁ + λ₂) of points ``(N, 3)``, at least ``LEAST``.

    Pauly, Gross and Kobbelt, "Efficient Simplification of Point-Sampled Surfaces", IEEE
    Visualization 2002; the λ are the eigenvalues of the covariance of the nearest points,
    ascending. It is 0 for a plane and at most 1/3.

    Raises:
        UserError: a point is not finite.
    """
    if not np.isfinite(points).all():
        raise UserError("points must be finite, got NaN or infinity.")
    tree = cKDTree(points)
    neighbours = min(NEIGHBOURS, len(points))
    result = np.full(len(points), LEAST)
    for start in range(0, len(points), PART):
        part = points[start : start + PART]
        rows = np.asarray(tree.query(part, k=neighbours)[1])
        rows = rows.reshape(len(part), -1)
        near = np.asarray(points, np.float64)[rows]
        offsets = near - near.mean(1, keepdims=True)
        covariances = offsets.transpose(0, 2, 1) @ offsets
        values = np.linalg.eigvalsh(covariances)
        total = values.sum(1)
        zeros = np.zeros(len(part))
        share = np.divide(values[:, 0], total, out=zeros, where=total > 0)
        result[start : start + PART] = np.maximum(share, LEAST)
    return result
