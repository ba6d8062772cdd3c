"""Single numbers of Python, NumPy and torch."""

from numbers import Integral, Real
from typing import Any


def python_number(value: Any) -> Any:
    """Return a NumPy or torch scalar as a Python number, and any other value as it is."""
    is_scalar = getattr(value, "shape", None) == ()
    if is_scalar:
        return value.item()
    return value


def is_whole_number(value: Any) -> bool:
    """Whether a Python number is whole by its type; True and False are not."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_real_number(value: Any) -> bool:
    """Whether a Python number is real by its type; True and False are not."""
    return isinstance(value, Real) and not isinstance(value, bool)
