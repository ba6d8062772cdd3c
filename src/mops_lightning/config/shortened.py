"""Settings of Lightning's trainer that shorten a training, such as ``fast_dev_run``."""

from collections.abc import Callable, Mapping
from typing import Any


def _is_set(value: Any) -> bool:
    return bool(value)


def _is_part(value: Any) -> bool:
    """Return whether a limit of batches leaves some out: Lightning reads 1.0 as all, 1 as one."""
    is_all = isinstance(value, float) and value == 1.0
    return value is not None and not is_all


def _is_limit(value: Any) -> bool:
    return value not in (None, -1)


SHORTENS: dict[str, Callable[[Any], bool]] = {
    "fast_dev_run": _is_set,
    "overfit_batches": _is_set,
    "limit_train_batches": _is_part,
    "max_steps": _is_limit,
    "max_time": _is_limit,
}
"""Arguments of the trainer, each with whether a value of it shortens the training."""


def shortening(config: Mapping[str, Any]) -> list[str]:
    """Return the settings that shorten the training of a run, such as ``trainer.max_steps=3``.

    Args:
        config: the run's settings as plain data, such as a record's or a weights file's.
    """
    trainer = config.get("trainer") or {}
    return [
        f"trainer.{name}={trainer[name]}"
        for name, shortens in SHORTENS.items()
        if name in trainer and shortens(trainer[name])
    ]
