"""Decorators that let numba compile loops."""

import hashlib
from contextlib import suppress
from functools import partial
from pathlib import Path
from pickle import UnpicklingError
from types import ModuleType
from typing import Any, cast

from numba import extending, njit, types
from numba.core.caching import FunctionCache

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""Distances never with ``fastmath``, which could change them."""

jit: Any = partial(njit, **OPTIONS, no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile a function that only compiled functions call."""

jit_inlined: Any = partial(jit, inline="always")
"""Compile a function within its callers: a call with arrays takes 40 ns."""


@cast(Any, extending.intrinsic)
def multiply_add(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a·b + c, rounded once."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return a(a, a, a), generate


@cast(Any, extending.intrinsic)
def float_bits(typing: Any, value: Any) -> Any:
    """Return the bits of a float, read as a signed integer of the same width."""
    integer = types.Integer.from_bitwidth(value.bitwidth, True)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], context.get_value_type(integer))

    return integer(value), generate


@cast(Any, extending.intrinsic)
def bits_float(typing: Any, bits: Any, like: Any) -> Any:
    """Return the float, of the type of ``like``, that has these bits."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], context.get_value_type(like))

    return like(bits, like), generate


class KeptForms(FunctionCache):
    """The compiled forms of a function in files, without which a call takes longer but succeeds."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return a compiled form, or None where its file is missing or broken."""
        with suppress(OSError, EOFError, UnpicklingError):
            return super().load_overload(sig, target_context)
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write a compiled form, unless that fails.

        Besides a full disk, numba raises "no compiled object yet" (RuntimeError) once in a while,
        when several processes compile the same functions for the first time.
        """
        with suppress(OSError, RuntimeError):
            super().save_overload(sig, data)


def jit_cached(function: Any, **options: Any) -> Any:
    """Compile, and keep the compiled form in a file next to the source or in the user's cache."""
    dispatcher = njit(function, **OPTIONS, **options)
    with suppress(RuntimeError):  # neither folder can be written to
        dispatcher._cache = KeptForms(function)  # as Dispatcher.enable_caching does
    return dispatcher


def jit_sums(function: Any) -> Any:
    """Compile as ``jit_cached``; sums may be added in any order, which vectorises products."""
    return jit_cached(function, fastmath={"reassoc", "contract"})


def jit_cached_with(*modules: ModuleType) -> Any:
    """Compile as ``jit_cached`` does a function that calls compiled functions of other modules.

    Numba does not notice a change of other files: the name of the compiled form holds their hash.
    """
    source = b"".join(Path(str(module.__file__)).read_bytes() for module in modules)

    def decorate(function: Any) -> Any:
        function.__qualname__ += f"_{hashlib.sha256(source).hexdigest()[:12]}"
        return jit_cached(function)

    return decorate
