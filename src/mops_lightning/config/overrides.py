"""Reading overrides such as ``++task/net@task.net=pcrnet`` with Hydra's own parser."""

from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from mops_lightning.errors import UserError

OWN = {"sampler": "sampler", "task": "task", "task.net": "task/net", "dataset": "dataset"}
"""Settings that describe an object of a class that may be the user's, and their groups."""
FOLDERS = ("out", "hydra.run.dir", "hydra.sweep.dir")
"""Folders that Hydra makes, which takes ``~`` for the name of a folder."""

if TYPE_CHECKING:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import Override


def parse_override(argument: str) -> "Override | None":
    """Read one argument of the command line.

    A value that Hydra cannot parse, such as a path with ``=`` in it, is taken as text.

    Returns:
        None for an option and for text that is not an override.
    """
    if argument.startswith("-"):
        return None
    return _parsed(argument) or _parsed(_quoted(argument))


def readable(argument: str) -> str:
    """Return an override in a form that Hydra reads, with its value quoted if need be."""
    is_readable = _parsed(argument) is not None
    if is_readable or not key(argument):
        return argument
    return _quoted(argument)


def key(argument: str) -> str:
    """Return the key that an override is about, such as ``task/net``; empty for anything else."""
    override = parse_override(argument)
    if override is None:
        return ""
    if override.package is None:
        return str(override.key_or_group)
    return f"{override.key_or_group}@{override.package}"


def path(argument: str) -> str:
    """Return the dotted place in the configuration that an override changes."""
    name, _, package = key(argument).partition("@")
    return package or name.replace("/", ".")


def with_own_classes(arguments: list[str]) -> list[str]:
    """Choose ``GROUP=own`` where a class from outside is named, and accept any setting of it.

    Args:
        arguments: such as ``["sampler._target_=my_package.MySampler", "sampler.x=3"]``. With a
            choice of the group, such as ``sampler=mops``, the settings of its file are kept.
    """
    keys = [key(argument) for argument in arguments]
    named = [setting for setting in OWN if f"{setting}._target_" in keys]
    below = tuple(f"{setting}." for setting in named)
    result = []
    for argument, name in zip(arguments, keys, strict=True):
        is_removal = argument.startswith("~")
        if name.startswith(below) and not is_removal:
            result.append(f"++{argument.lstrip('+')}")
        else:
            result.append(argument)
    for setting in named:
        if OWN[setting] not in keys:
            result.append(f"{OWN[setting]}=own")
    return result


def with_home(argument: str) -> str:
    """Return an override with the ``~`` of a run's folder replaced by the home folder.

    Raises:
        UserError: there is no such user.
    """
    override = parse_override(argument)
    if override is None or override.is_sweep_override() or key(argument) not in FOLDERS:
        return argument
    folder = str(override.value())
    if not folder.startswith("~"):
        return argument
    try:
        expanded = str(Path(folder).expanduser())
    except RuntimeError:
        raise UserError(
            f"{argument}: no user has this name. For a folder, write ./{folder}"
        ) from None
    name = argument.partition("=")[0]
    return f"{name}={quote(expanded)}"


def as_typed(arguments: Any) -> list[str]:
    """Return a list of overrides with their interpolations as the user typed them.

    Args:
        arguments: a list in ``hydra.overrides``; OmegaConf would resolve its interpolations among
            Hydra's own settings.
    """
    plain: Any = OmegaConf.to_container(arguments, resolve=False)
    return list(plain)


def quote(text: str) -> str:
    """Return a text as a value that Hydra reads back as it is."""
    from hydra.core.override_parser.types import Quote, QuotedString

    return QuotedString(text, Quote.single).with_quotes()


def _quoted(argument: str) -> str:
    name, sign, value = argument.partition("=")
    return f"{name}{sign}{quote(value)}"


@lru_cache(maxsize=4096)  # several checks read the same arguments, and the parser is slow
def _parsed(argument: str) -> "Override | None":
    from hydra.errors import HydraException

    try:
        return _parser().parse_override(argument)
    except HydraException:
        return None


@cache
def _parser() -> "OverridesParser":
    from hydra.core.override_parser.overrides_parser import OverridesParser

    return OverridesParser.create()
