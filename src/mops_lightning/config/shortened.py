"""Settings of Lightning's trainer that shorten a training, such as ``fast_dev_run``."""

from collections.abc import Callable, Mapping
from typing import Any

UNLIMITED = -1
"""Value of ``max_epochs`` and ``max_steps`` for no limit."""


def _is_set(value: Any) -> bool:
    return bool(value)


def _leaves_batches_out(value: Any) -> bool:
    """Return whether a limit of batches leaves some out: Lightning reads 1.0 as all, 1 as one."""
    is_all = isinstance(value, float) and value == 1.0
    return value is not None and not is_all


def _is_limit(value: Any) -> bool:
    return value not in (None, UNLIMITED)


SHORTENS: dict[str, Callable[[Any], bool]] = {
    "fast_dev_run": _is_set,
    "overfit_batches": _is_set,
    "limit_train_batches": _leaves_batches_out,
    "max_steps": _is_limit,
    "max_time": _is_limit,
}
"""Arguments of the trainer, each with whether a value of it shortens the training."""


def has_step_limit(trainer: Mapping[str, Any]) -> bool:
    """Return whether ``max_steps`` or ``fast_dev_run`` ends the training."""
    return _is_limit(trainer.get("max_steps")) or bool(trainer.get("fast_dev_run"))


def planned_steps(trainer: Mapping[str, Any], of_epoch: int) -> int:
    """Return the optimizer steps of a whole training: of its epochs, or ``max_steps`` without.

    Args:
        trainer: settings of Lightning's trainer.
        of_epoch: steps of an epoch.
    """
    if trainer["max_epochs"] == UNLIMITED:
        return int(trainer.get("max_steps") or 0)
    return of_epoch * int(trainer["max_epochs"])


def shortening(config: Mapping[str, Any]) -> list[str]:
    """Return the settings that shorten the training of a run, such as ``trainer.max_steps=3``.

    Args:
        config: the run's settings as plain data, such as a record's or a weights file's.
    """
    trainer = config.get("trainer") or {}
    is_planned_in_steps = trainer.get("max_epochs") == UNLIMITED
    settings = []
    for name, shortens in SHORTENS.items():
        if name == "max_steps" and is_planned_in_steps:
            continue
        if name in trainer and shortens(trainer[name]):
            settings.append(f"trainer.{name}={trainer[name]}")
    return settings
