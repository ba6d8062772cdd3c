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
def wide_layers_mixed(device: str) -> Iterator[None]:
    """Leave autocast but for ``wide_layers``, which take over its precision; for training.

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


def wide_dtype() -> torch.dtype | None:
    """Return the precision of ``wide_layers``, None outside of ``wide_layers_mixed``."""
    return _WIDE.get()


def wide_layers(device: str) -> AbstractContextManager[Any]:
    """Run layers that every point goes through, in mixed precision where that is asked for.

    Args:
        device: type of the device, such as ``cuda``.
    """
    dtype = _WIDE.get()
    return nullcontext() if dtype is None else torch.autocast(device, dtype=dtype)
