"""Comparing plain values with annotations; imports neither Hydra nor OmegaConf."""

import collections.abc
import types
from typing import Any, Literal, Union, get_args, get_origin

PLAIN: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    type(None): "null",
}
"""Annotations in words, behind "must be"."""
LISTS = (list, tuple, collections.abc.Sequence)
"""Origins of annotations of lists."""


def misfit(value: Any, annotation: Any) -> str | None:
    """Say what an annotation wants when a value does not fit it.

    Args:
        value: plain data: a number, a text, a truth value, None, a list or a dict.
        annotation: as written in the signature. What is neither plain, a list of plain nor a choice
            of these cannot be judged, and any value fits.

    Returns:
        Such as "a whole number or null"; None where the value fits.
    """
    return None if _fits(value, annotation) else describe(annotation)


def _fits(value: Any, annotation: Any) -> bool:
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in inner)
    if origin is Literal:
        # A wrong text is left to the constructor, which names the nearest right one.
        return isinstance(value, str) or any(value is part for part in inner)
    if origin in LISTS:
        return isinstance(value, list) and all(_fits(item, inner[0]) for item in value)
    if annotation is float:
        return type(value) in (int, float)
    if annotation in PLAIN:
        return type(value) is annotation
    # A tensor, a callable, Any ...: a number or nothing may be right, a text is not a tensor.
    return getattr(annotation, "__name__", "") != "Tensor" or isinstance(value, int | float)


def describe(annotation: Any) -> str:
    """Say in words what an annotation wants."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        wanted = [describe(part) for part in inner if getattr(part, "__name__", "") != "Tensor"]
        return " or ".join(dict.fromkeys(wanted))
    if origin is Literal:
        return " or ".join(map(str, inner))
    if origin in LISTS:
        kinds = {int: " of whole numbers", float: " of numbers", str: " of strings"}
        return f"a list{kinds.get(inner[0], '')}"
    return PLAIN.get(annotation, str(annotation))
