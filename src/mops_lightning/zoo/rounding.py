"""Wide weight matrices of models in 16 or 8 bits, which makes files smaller."""

import torch
from torch import Tensor

from mops_lightning.zoo.model_file import Precision

WIDE = 4096
"""Weight matrices with this number of entries may be rounded."""
SCALE = ".scale"
"""End of the name of the scales (rows, 1), float32, of a matrix in 8 bits."""
LARGEST = 127


def is_wide(value: Tensor) -> bool:
    """Whether a tensor is a weight matrix that may be rounded."""
    return value.ndim == 2 and value.numel() >= WIDE


def rounded(state: dict[str, Tensor], precision: Precision) -> dict[str, Tensor]:
    """Return tensors with the wide weight matrices in 16 or 8 bits.

    A row in 8 bits is a float32 scale times integers from -127 to 127, so an entry differs by at
    most 1/254 of the largest of its row.

    Args:
        state: tensors by name.
        precision: of matrices with at least ``WIDE`` entries; float32 changes nothing.
    """
    result = dict(state)
    for name, value in state.items():
        if not is_wide(value):
            continue
        if precision == "int8":
            largest = value.float().abs().amax(dim=1, keepdim=True)
            scale = torch.where(largest > 0, largest / LARGEST, 1.0)
            result[name] = (value / scale).round().to(torch.int8)
            result[name + SCALE] = scale
        else:
            result[name] = value.to(getattr(torch, precision))
    return result


def restored(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return tensors with matrices in int8 as float32, without their scales."""
    result = dict(state)
    for name, value in state.items():
        scale = state.get(name + SCALE)
        if scale is None or value.dtype != torch.int8 or value.ndim != 2:
            continue
        if scale.shape == (len(value), 1) and scale.dtype == torch.float32:
            result[name] = value * scale
            del result[name + SCALE]
    return result
