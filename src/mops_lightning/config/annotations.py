"""Comparing plain values with annotations by msgspec; imports neither Hydra nor OmegaConf."""

import re
from inspect import Parameter
from types import UnionType
from typing import Any, Union, get_args, get_origin

import msgspec

WORDS = {
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "str": "a text",
    "array": "a list",
}
"""Msgspec's names of types in words, behind "must be"."""


def misfit(value: Any, annotation: Any) -> str | None:
    """Say what an annotation wants when a value does not fit it.

    Args:
        value: plain data: a number, a text, a truth value, None, a list or a dict.
        annotation: as written in the signature. One that msgspec does not know fits any value.

    Returns:
        Such as "a whole number or null"; None where the value fits. A wrong text of several fixed
        ones fits: the constructor names the nearest right one.
    """
    if get_origin(annotation) in (Union, UnionType):  # rates of torch's optimizers may be tensors
        parts = (one for one in get_args(annotation) if getattr(one, "__name__", "") != "Tensor")
        annotation = Union[tuple(parts)]  # noqa: UP007
    if annotation is Parameter.empty:
        return None
    try:
        msgspec.convert(value, annotation)
    except msgspec.ValidationError as error:
        if expected := re.match("Expected `([^`]+)`", str(error)):
            words = " or ".join(WORDS.get(word, word) for word in expected[1].split(" | "))
            return f"a list, each of it {words}" if "`$[" in str(error) else words
    except TypeError:
        pass
    return None
