"""Mixed precision for the pointwise layers only.

Coordinates, distances, statistics and the sampling matrix need more than the three significant
digits of bfloat16, and cost little compared with the wide layers that process every point. A step
therefore disables autocast, and only the pointwise layers enable it again.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from typing import Any

import torch

_POINTWISE: ContextVar[torch.dtype | None] = ContextVar("pointwise", default=None)


def full_precision(device: str) -> torch.autocast:
    """Disable autocast, for scoring.

    Args:
        device: device type, such as ``cuda``.
    """
    return torch.autocast(device, enabled=False)


@contextmanager
def restrict_autocast_to_pointwise(device: str) -> Iterator[None]:
    """Disable autocast except in ``pointwise_autocast``, which keeps its dtype.

    Calls may be nested; the inner ones change nothing. In a graph of ``torch.compile`` or
    ``torch.export``, which cannot read context variables, all layers keep full precision.

    Args:
        device: device type, such as ``cuda``.
    """
    if torch.compiler.is_compiling():
        with full_precision(device) if torch.is_autocast_enabled(device) else nullcontext():
            yield
        return
    mixed = torch.is_autocast_enabled(device)
    dtype = _POINTWISE.get()
    if mixed:
        dtype = torch.get_autocast_dtype(device)
    token = _POINTWISE.set(dtype)
    try:
        with full_precision(device):
            yield
    finally:
        _POINTWISE.reset(token)


def pointwise_autocast_dtype() -> torch.dtype | None:
    """Return the dtype of ``pointwise_autocast``, or None without mixed precision."""
    if torch.compiler.is_compiling():
        return None
    return _POINTWISE.get()


def pointwise_autocast(device: str) -> AbstractContextManager[Any]:
    """Run pointwise layers in mixed precision if the training uses it.

    Args:
        device: device type, such as ``cuda``.
    """
    dtype = pointwise_autocast_dtype()
    if dtype is None:
        return nullcontext()
    return torch.autocast(device, dtype=dtype)
