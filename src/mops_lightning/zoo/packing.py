"""Weight matrices in 8 bits: whole numbers, and one scale per row."""

import torch
from torch import Tensor

SCALE = ".scale"
"""Ends the name of the scales that belong to a matrix."""

LARGEST = 127


def pack(name: str, weight: Tensor) -> dict[str, Tensor]:
    """Return a weight matrix as ``int8`` with its scales, by name.

    Every row is divided by its largest absolute value / 127 and rounded, so that no entry changes
    by more than 1/254 of that value. What was unpacked is packed to the same numbers.

    Args:
        name: of the matrix.
        weight: ``(R, C)``.
    """
    scale = weight.abs().amax(1, keepdim=True) / LARGEST
    whole = (weight / scale.clamp_min(torch.finfo(torch.float32).tiny)).round()
    return {name: whole.to(torch.int8), f"{name}{SCALE}": scale[:, 0].contiguous()}


def unpack(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return tensors by name with ``int8`` matrices in ``float32``, without their scales.

    Raises:
        ValueError: a matrix has no scale for every row.
    """
    found = dict(state)
    for name, value in state.items():
        if value.dtype == torch.int8:
            scale = found.pop(f"{name}{SCALE}", None)
            if value.ndim != 2 or scale is None or scale.shape != value.shape[:1]:
                raise ValueError(f"{name} has no scale for every row")
            found[name] = value.float() * scale[:, None]
    return found
