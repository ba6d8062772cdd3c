"""Clouds one after the other, as in PyTorch Geometric; without torch."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.errors import UserError


def cloud_sizes(number: int, batch: NDArray[Any], name: str = "batch") -> NDArray[np.int64]:
    """Return the number of points ``(B,)`` of every cloud.

    Args:
        number: P, of points.
        batch: ``(P,)`` the cloud of every point, ascending from 0, as in PyTorch Geometric.
        name: of the argument, for errors.
    """
    is_whole = batch.dtype.kind in "iub"
    if batch.shape != (number,) or not is_whole:
        raise UserError(
            f"{name} must be whole numbers of shape (P={number},), got {batch.dtype} of shape "
            f"{batch.shape}."
        )
    if number:
        is_negative = batch[0] < 0
        falls = batch[1:] < batch[:-1]
        descends = bool(falls.any())
        if is_negative or descends:
            raise UserError(f"{name} must be ascending and at least 0. Sort the points by cloud.")
    return np.bincount(batch.astype(np.int64))
