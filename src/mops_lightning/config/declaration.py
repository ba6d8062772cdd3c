"""The words of a declaration: what a setting affects, its limits, and the setting itself."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Flag, auto
from typing import Any


class Affects(Flag):
    """What a setting changes.

    ``TRAINING`` is what is learned: such a setting belongs to the identity of a resumed run and to
    the key of a cached task net. ``SCORES`` is what is measured on the test clouds. Settings that
    affect ``NOTHING`` may differ between two starts of a sweep.
    """

    NOTHING = 0
    TRAINING = auto()
    SCORES = auto()
    RESULTS = TRAINING | SCORES


@dataclass(frozen=True)
class Limits:
    """Which values a setting takes.

    Attributes:
        allowed: in words, behind "must be".
        fits: whether a value is one of them.
        choices: all of them, if they have names.
    """

    allowed: str
    fits: Callable[[Any], bool]
    choices: tuple[str, ...] = ()


def whole(minimum: int) -> Limits:
    """Allow whole numbers of at least ``minimum``."""
    return Limits(
        f"a whole number of at least {minimum}", lambda x: type(x) is int and x >= minimum
    )


def number(allowed: str, fits: Callable[[float], bool]) -> Limits:
    """Allow finite numbers in a range."""
    return Limits(
        f"a number {allowed}",
        lambda x: isinstance(x, int | float) and abs(x) < float("inf") and fits(x),
    )


def or_null(limits: Limits) -> Limits:
    """Allow null, too."""
    return Limits(f"{limits.allowed}, or null", lambda x: x is None or limits.fits(x))


def one_of(*choices: str, others: tuple[Any, ...] = ()) -> Limits:
    """Allow named choices, and ``others`` that are other spellings of them."""
    return Limits(
        f"one of {', '.join(choices)}", lambda x: x in choices or x in others, choices=choices
    )


@dataclass(frozen=True)
class Setting:
    """One setting.

    Attributes:
        help: its text in ``--help``.
        affects: what it changes.
        limits: which values it takes; None: all of its type.
        learn: the values of ``learn`` with which it counts; None: with all.
        group: whether it is a group of choices, which ``--help`` lists elsewhere.
        nullable: whether it may be removed or null.
        per_learn: whether it has one entry for learn=task and one for training a sampler.
        by_content: whether a run is identified by the content of the files that it names.
        repeat: whether ``evaluate=RUN`` takes it from RUN; None: if it affects anything.
        compare: whether ``report`` refuses runs in one table that differ in it; None: if it
            affects anything.
    """

    help: str = ""
    affects: Affects = Affects.RESULTS
    limits: Limits | None = None
    learn: tuple[str, ...] | None = None
    group: bool = False
    nullable: bool = False
    per_learn: bool = False
    by_content: bool = False
    repeat: bool | None = None
    compare: bool | None = None

    def counts(self, learn: str) -> bool:
        """Return whether it makes a difference with this value of ``learn``."""
        return self.learn is None or learn in self.learn

    @property
    def repeated(self) -> bool:
        """Whether ``evaluate=RUN`` takes it from RUN."""
        return bool(self.affects) if self.repeat is None else self.repeat

    @property
    def compared(self) -> bool:
        """Whether ``report`` compares it."""
        return bool(self.affects) if self.compare is None else self.compare


def about(text: str, affects: Affects = Affects.RESULTS, **more: Any) -> dict[str, Setting]:
    """Return the metadata of a field of ``RunSettings``; see ``Setting``."""
    return {"setting": Setting(text, affects, **more)}


def group(affects: Affects = Affects.RESULTS, **more: Any) -> dict[str, Setting]:
    """Return the metadata of a group of choices."""
    return about("", affects, group=True, **more)


def table(text: str) -> dict[str, Setting]:
    """Return the metadata of what only other settings read, which count in its place."""
    return about(text, Affects.NOTHING, repeat=True)
