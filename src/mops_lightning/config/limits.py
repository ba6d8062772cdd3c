"""Limits of settings: the values that one takes, in words and as a function."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


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


def one_of(*choices: str, others: tuple[Any, ...] = ()) -> Limits:
    """Allow named choices, and ``others`` that are other spellings of them."""
    return Limits(
        f"one of {', '.join(choices)}", lambda x: x in choices or x in others, choices=choices
    )


ABOVE_ZERO = number("above 0", lambda x: x > 0)

PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")
"""Allowed values of ``trainer.precision``; Lightning has more."""

_FIXED = Limits("left out, because the program sets it", lambda x: False)

TRAINER = {
    "max_epochs": whole(0),
    # A run that is shortened in these ways tests or trains nothing that anybody wants to know.
    "fast_dev_run": Limits("false; try epochs.sampler=1", lambda x: not x),
    "overfit_batches": Limits("0; give fewer clouds", lambda x: not x),
    "max_steps": Limits(
        "-1 or a whole number of at least 1", lambda x: x == -1 or whole(1).fits(x)
    ),
    "max_time": Limits("null or a time, such as 00:08:00:00", lambda x: x is None or bool(x)),
    # Lightning uses these only when training begins, after pretraining.
    "gradient_clip_val": Limits(
        "null or a number above 0", lambda x: x is None or ABOVE_ZERO.fits(x)
    ),
    "accumulate_grad_batches": whole(1),
    "limit_train_batches": ABOVE_ZERO,
    "limit_test_batches": ABOVE_ZERO,
    "deterministic": Limits("true, false or warn", lambda x: x in (True, False, None, "warn")),
    "precision": one_of(*PRECISIONS, others=("32", 32, None)),
    # Those that start every process as this program.
    "strategy": one_of("auto", "ddp", "ddp_find_unused_parameters_true"),
    # Each process pools and normalises its share of a batch in one step.
    "sync_batchnorm": Limits("false", lambda x: not x),
    "plugins": _FIXED,
    "log_every_n_steps": _FIXED,
    "default_root_dir": _FIXED,
    "num_sanity_val_steps": _FIXED,
    "enable_model_summary": _FIXED,
    "enable_progress_bar": _FIXED,
}
"""Limits of settings of Lightning's trainer."""
