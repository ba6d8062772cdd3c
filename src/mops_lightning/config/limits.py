"""Limits of settings: the values that one takes, in words and as a function."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from mops_lightning.errors import UserError, did_you_mean


@dataclass(frozen=True)
class Limits:
    """The values that a setting takes.

    Attributes:
        allowed: in words, behind "must be".
        fits: whether a value is one of them.
        choices: all of them, if they have names.
    """

    allowed: str
    fits: Callable[[Any], bool]
    choices: tuple[str, ...] = ()

    def refusal(self, path: str, value: Any) -> UserError:
        """Return the error about a value of a setting that does not fit."""
        hint = ""
        if self.choices:
            hint, _, _ = did_you_mean(str(value), self.choices).partition(" Allowed:")
        return UserError(f"{path} must be {self.allowed}, got {value!r}.{hint}")


def whole(minimum: int) -> Limits:
    """Allow whole numbers of at least ``minimum``."""

    def fits(value: Any) -> bool:
        return type(value) is int and value >= minimum

    return Limits(f"a whole number of at least {minimum}", fits)


def number(allowed: str, fits: Callable[[float], bool]) -> Limits:
    """Allow finite numbers in a range."""

    def fits_and_is_finite(value: Any) -> bool:
        is_finite = isinstance(value, int | float) and abs(value) < float("inf")
        return is_finite and fits(value)

    return Limits(f"a number {allowed}", fits_and_is_finite)


def one_of(*choices: str, others: tuple[Any, ...] = ()) -> Limits:
    """Allow named choices, and ``others`` that are other spellings of them."""
    allowed = (*choices, *others)
    return Limits(f"one of {', '.join(choices)}", lambda x: x in allowed, choices)


def _unlimited_or(minimum: int) -> Limits:
    """Allow -1, Lightning's value for no limit, and whole numbers of at least ``minimum``."""
    numbers = whole(minimum)
    return Limits(f"-1 or {numbers.allowed}", lambda x: x == -1 or numbers.fits(x))


def _is_time(value: Any) -> bool:
    """Return whether Lightning reads a value as days, hours, minutes and seconds, or as none."""
    if isinstance(value, str):
        return re.fullmatch(r"\d+:\d\d:\d\d:\d\d", value.strip()) is not None
    return value is None or (isinstance(value, Mapping) and bool(value))


def _starts_processes_by_a_command(value: Any) -> bool:
    """Return whether a strategy is none of those that copy this process, and with it a run."""
    copying = ("spawn", "fork", "notebook")
    return not (isinstance(value, str) and any(name in value for name in copying))


ABOVE_ZERO = number("above 0", lambda x: x > 0)

_ELSEWHERE = {
    "logger": "logger=NAME; logger=none for none",
    "callbacks": "callbacks.NAME._target_=CLASS",
}
"""Arguments of Lightning's trainer that are groups of settings, and how to set these."""

TRAINER = {
    "max_epochs": _unlimited_or(0),
    # Lightning uses these only when training begins, after pretraining.
    "max_steps": _unlimited_or(1),
    "max_time": Limits("null or a time, such as 00:08:00:00", _is_time),
    "strategy": Limits(
        "one that starts processes by a command, such as ddp", _starts_processes_by_a_command
    ),
    "gradient_clip_val": Limits(
        "null or a number above 0", lambda x: x is None or ABOVE_ZERO.fits(x)
    ),
    "accumulate_grad_batches": whole(1),
    "log_every_n_steps": whole(1),
    "deterministic": Limits("true, false or warn", lambda x: x in (True, False, None, "warn")),
    **{
        name: Limits(f"left out; give {instead}", lambda x: False)
        for name, instead in _ELSEWHERE.items()
    },
}
"""Limits of settings of Lightning's trainer, which checks all others itself."""
