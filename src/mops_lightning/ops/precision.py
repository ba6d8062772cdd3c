"""Mixed precision, where it does no harm: in the wide layers that every point goes through.

Coordinates, distances, statistics and the sampling matrix need more than the three digits of
bfloat16, and cost little beside those layers. So a step leaves autocast, and the wide layers alone
go back into it.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from typing import Any

import torch

_WIDE: ContextVar[torch.dtype | None] = ContextVar("wide", default=None)


def full_precision(device: str) -> torch.autocast:
    """Leave autocast altogether, for scores.

    Args:
        device: type of the device, such as ``cuda``.
    """
    return torch.autocast(device, enabled=False)


@contextmanager
def restrict_autocast_to_pointwise(device: str) -> Iterator[None]:
    """Leave autocast but for ``pointwise_autocast``, which take over its precision; for training.

    Args:
        device: type of the device, such as ``cuda``.
    """
    mixed = torch.is_autocast_enabled(device)
    token = _WIDE.set(torch.get_autocast_dtype(device) if mixed else None)
    try:
        with full_precision(device):
            yield
    finally:
        _WIDE.reset(token)


def pointwise_autocast_dtype() -> torch.dtype | None:
    """Return the precision of ``pointwise_autocast``; None where autocast is off."""
    return _WIDE.get()


def pointwise_autocast(device: str) -> AbstractContextManager[Any]:
    """Run layers that every point goes through, in mixed precision where that is asked for.

    Args:
        device: type of the device, such as ``cuda``.
    """
    dtype = _WIDE.get()
    return nullcontext() if dtype is None else torch.autocast(device, dtype=dtype)
