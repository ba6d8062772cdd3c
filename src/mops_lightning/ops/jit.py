"""Decorators that let numba compile loops."""

from functools import partial
from typing import Any

from numba import extending, njit

jit: Any = partial(njit, nogil=True, error_model="numpy")
"""Compile; never with ``fastmath``, which could change distances."""

intrinsic: Any = extending.intrinsic


def jit_cached(function: Any) -> Any:
    """Compile, and keep the compiled form in a file next to the source or in the user's cache."""
    try:
        return jit(function, cache=True)
    except RuntimeError:  # neither folder can be written to
        return jit(function)
