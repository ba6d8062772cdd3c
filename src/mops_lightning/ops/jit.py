"""Decorators that let numba compile loops."""

from functools import partial
from typing import Any, cast

from numba import extending, njit

jit: Any = partial(njit, nogil=True, error_model="numpy")
"""Compile; distances never with ``fastmath``, which could change them."""


@cast(Any, extending.intrinsic)
def multiply_add(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a·b + c, rounded once."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return a(a, a, a), generate


def jit_cached(function: Any) -> Any:
    """Compile, and keep the compiled form in a file next to the source or in the user's cache."""
    try:
        return jit(function, cache=True)
    except RuntimeError:  # neither folder can be written to
        return jit(function)


def jit_sums(function: Any) -> Any:
    """Compile as ``jit_cached``; sums may be added in any order, which vectorises products."""
    order: Any = {"reassoc", "contract"}
    try:
        return jit(function, cache=True, fastmath=order)
    except RuntimeError:  # neither folder can be written to
        return jit(function, fastmath=order)
