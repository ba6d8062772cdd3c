"""Overrides that a user gives, checked before Hydra composes: its own errors would name no key."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mops_lightning.config import settings
from mops_lightning.config.declaration import Setting
from mops_lightning.config.explain import no_such_setting
from mops_lightning.config.groups import choice_groups, has_choice, keys_of_files
from mops_lightning.config.overrides import key as key_of
from mops_lightning.config.overrides import parse_override
from mops_lightning.errors import UserError

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

MOST_VALUES = 1e5
"""Most values of one range in a sweep."""

NOT_VERBOSE = (int, float, dict, type(None))
"""Types of values of ``hydra.verbose`` that Hydra would fail on."""

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

    A mistyped key is refused here, too, if no file sets it: Hydra composes twice before it says so.

    Raises:
        UserError: there is no key, an unknown one, or a group of choices is set to something else
            than a name.
    """
    groups = choice_groups()
    known = {*settings.declared(), *groups, "hydra"}
    has_flags = any(argument.startswith("-") for argument in arguments)  # may name other files
    for argument in arguments:
        override = parse_override(argument)
        name = key_of(argument)
        top = name.partition(".")[0]
        if top == "names":
            raise UserError(f"{argument}: names follow from the chosen groups. Leave it out.")
        if override is None:
            continue
        _check(argument, name, override, groups)
        if top not in known and _is_change(override) and not has_flags:
            raise UserError(no_such_setting(name, arguments))
    if not has_flags:
        _check_inner_keys(arguments, groups)


def _check_inner_keys(arguments: Sequence[str], groups: list[str]) -> None:
    """Refuse a key such as ``sampler.alhpa``, unless other arguments or files could set it.

    Raises:
        UserError: no file of ``conf/`` has the key.
    """
    overrides = [parse_override(argument) for argument in arguments]
    given = [override for override in overrides if override is not None]
    if any(_may_bring_keys(override, groups) for override in given):
        return
    known = keys_of_files() | settings.declared().keys()
    for override in given:
        parts = override.key_or_group.split(".")
        if parts[0] == "hydra" or not _is_change(override):
            continue
        for depth, part in enumerate(parts, 1):
            is_index = part.isdecimal()
            if not is_index and part not in known:
                raise UserError(no_such_setting(".".join(parts[:depth]), arguments))


def _may_bring_keys(override: "Override", groups: list[str]) -> bool:
    """Return whether an override can set keys that no file of ``conf/`` has."""
    name = override.key_or_group
    is_addition = override.is_add() or override.is_force_add()
    if is_addition or name.startswith("hydra") or name.endswith("._target_"):
        return True
    if override.is_delete():
        return False
    value: Any = override.value()
    if name in groups:
        return not has_choice(name, str(value))
    return isinstance(value, dict)


def _is_change(override: "Override") -> bool:
    """Return whether an override changes a setting, which must exist for that."""
    is_addition = override.is_add() or override.is_force_add()
    is_in_group = override.package is not None or "/" in override.key_or_group
    return not (is_addition or override.is_delete() or is_in_group)


def _check(argument: str, name: str, override: "Override", groups: list[str]) -> None:
    """Check one override; ``name`` is its key."""
    if not name:
        raise UserError(f"{argument!r} has no key. Settings are KEY=VALUE.")
    value: Any = override.value()
    if override.is_range_sweep():
        _check_range(argument, value)
    if override.is_delete():
        _check_removal(argument, name, value, groups)
    elif name == "hydra.verbose" and type(value) in NOT_VERBOSE:
        raise UserError(f"{argument}: give true, false, or a list of loggers.")
    elif _chooses(name, value, groups):
        _check_choices(argument, name, override)
    elif not override.is_sweep_override():
        _check_limits(name, value)


def _check_range(argument: str, swept: Any) -> None:
    """Refuse a range of more values than any sweep has."""
    length = abs(swept.stop - swept.start)
    if length > MOST_VALUES * abs(swept.step):
        raise UserError(f"{argument}: more than 100,000 values. Give fewer.")


def _check_removal(argument: str, name: str, value: Any, groups: list[str]) -> None:
    """Check the removal of a setting or of a choice, such as ``~logger``."""
    group = name.partition("@")[0]
    setting = settings.declared().get(group, Setting(nullable=True))
    if setting.group and not setting.nullable:
        hint = OTHERWISE.get(name, "")
        raise UserError(
            f"{argument}: {name} cannot be removed; choose another one with {name}=NAME{hint}."
        )
    if group in groups and value is not None and not _is_choice(value, group):
        raise UserError(f"{argument}: write ~{name}.")


def _check_limits(path: str, value: Any) -> None:
    """Refuse a number outside of a setting's limits before anything heavy is imported.

    All else may be converted or resolved, and is checked in the composed configuration.
    """
    limits = settings.limits(path)
    is_number = isinstance(value, int | float)
    if limits is not None and is_number and not limits.fits(value):
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
    if name == "baselines" and value == {}:  # none
        return
    values = [value]
    if override.is_choice_sweep():
        values = value.list
    elif override.is_sweep_override():
        return
    group = name.partition("@")[0]
    if not all(_is_choice(choice, group) for choice in values):
        hint = OTHERWISE.get(name, "")
        raise UserError(f"{argument}: choose one with {name}=NAME{hint}.")


def _is_choice(value: Any, group: str) -> bool:
    """Return whether a value is a choice of a group: a name, or settings of a top-level object."""
    from hydra.core.override_parser.types import QuotedString

    if isinstance(value, str | QuotedString):
        return True
    is_top_level = "/" not in group
    return is_top_level and isinstance(value, dict) and value != {}
