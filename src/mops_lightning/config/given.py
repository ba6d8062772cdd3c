"""Overrides that a user gives, checked before Hydra composes: its own errors would name no key."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mops_lightning.config import settings
from mops_lightning.config.groups import choice_groups
from mops_lightning.config.overrides import key as key_of
from mops_lightning.config.overrides import parse_override
from mops_lightning.errors import UserError

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

MOST_VALUES = 1e5
"""Most values of one range in a sweep."""

OTHERWISE = {
    "logger": " (logger=none for none)",
    "callbacks": " or leave single callbacks out with callbacks.NAME=null",
    "baselines": " or leave single baselines out with baselines.NAME=null",
    "experiment": " or leave it out",
    "debug": " or leave it out",
}
"""Hint for omitting a choice, by group."""


def check_overrides(arguments: Sequence[str]) -> None:
    """Refuse ``logger=null`` and the like: Hydra's error has no key, or there is none.

    Raises:
        UserError: there is no key, or a group of choices is set to something else than a name.
    """
    groups = choice_groups()
    for argument in arguments:
        override = parse_override(argument)
        name = key_of(argument)
        if name.partition(".")[0] == "names":
            raise UserError(f"{argument}: names follow from the chosen groups. Leave it out.")
        if override is not None:
            _check(argument, name, override, groups)


def _check(argument: str, name: str, override: "Override", groups: list[str]) -> None:
    """Check one override; ``name`` is its key."""
    if not name:
        raise UserError(f"{argument!r} has no key. Settings are KEY=VALUE.")
    value: Any = override.value()
    if override.is_range_sweep() and abs(value.stop - value.start) > MOST_VALUES * abs(value.step):
        raise UserError(f"{argument}: more than 100,000 values. Give fewer.")
    if override.is_delete():
        _check_removal(argument, name, value, groups)
    elif name == "hydra.verbose" and type(value) in (int, float, dict, type(None)):
        raise UserError(f"{argument}: give true, false, or a list of loggers.")
    elif _chooses(name, value, groups):
        _check_choices(argument, name, override)
    elif not override.is_sweep_override():
        _check_limits(name, value)


def _check_removal(argument: str, name: str, value: Any, groups: list[str]) -> None:
    """Check the removal of a setting or of a choice, such as ``~logger``."""
    group = name.partition("@")[0]
    declared = settings.declared().get(group)
    if declared is not None and declared.group and not declared.nullable:
        other = f"choose another one with {name}=NAME{OTHERWISE.get(name, '')}"
        raise UserError(f"{argument}: {name} cannot be removed; {other}.")
    if group in groups and value is not None and not _is_choice(value, group):
        raise UserError(f"{argument}: write ~{name}.")


def _check_limits(path: str, value: Any) -> None:
    """Refuse a number outside of a setting's limits before anything heavy is imported.

    All else may be converted or resolved, and is checked in the composed configuration.
    """
    is_declared = path in settings.declared() or path in settings.INSIDE
    limits = settings.of(path).limits
    if not is_declared or limits is None or not isinstance(value, int | float):
        return
    if not limits.fits(value):
        raise limits.refusal(path, value)


def _chooses(name: str, value: Any, groups: list[str]) -> bool:
    """Return whether an override chooses from a group, of ours or of Hydra's."""
    group = name.partition("@")[0]
    if group in groups or group == "hydra":
        return True
    return group.startswith("hydra/") and isinstance(value, list | dict)


def _check_choices(argument: str, name: str, override: "Override") -> None:
    """Check that a group is set to the name of a choice, or swept over names."""
    value: Any = override.value()
    values = [value]
    if override.is_sweep_override():
        values = value.list if override.is_choice_sweep() else []
    group = name.partition("@")[0]
    has_no_baseline = name == "baselines" and value == {}
    if not has_no_baseline and not all(_is_choice(one, group) for one in values):
        raise UserError(f"{argument}: choose one with {name}=NAME{OTHERWISE.get(name, '')}.")


def _is_choice(value: Any, group: str) -> bool:
    """Return whether a value is a choice of a group: a name, or settings of a top-level object."""
    from hydra.core.override_parser.types import QuotedString

    is_settings = isinstance(value, dict) and bool(value) and "/" not in group
    return isinstance(value, str | QuotedString) or is_settings
