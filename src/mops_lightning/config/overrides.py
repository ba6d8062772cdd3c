"""Reading overrides such as ``++task/net@task.net=pcrnet`` with Hydra's own parser."""

from functools import cache
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
    return None if argument.startswith("-") else _parsed(argument) or _parsed(_quoted(argument))


def readable(argument: str) -> str:
    """Return an override in a form that Hydra reads, with its value quoted if need be."""
    return _quoted(argument) if key(argument) and not _parsed(argument) else argument


def key(argument: str) -> str:
    """Return the key that an override is about, such as ``task/net``; empty for anything else."""
    override = parse_override(argument)
    if override is None:
        return ""
    package = f"@{override.package}" if override.package is not None else ""
    return f"{override.key_or_group}{package}"


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
    places = [place for place in OWN if f"{place}._target_" in keys]
    chosen = [f"{OWN[place]}=own" for place in places if OWN[place] not in keys]
    below = tuple(f"{place}." for place in places)
    return [
        f"++{argument.lstrip('+')}" if name.startswith(below) and argument[0] != "~" else argument
        for argument, name in zip(arguments, keys, strict=True)
    ] + chosen


def with_home(argument: str) -> str:
    """Return an override with the ``~`` of a run's folder replaced by the home folder.

    Raises:
        UserError: there is no such user.
    """
    override = parse_override(argument)
    swept = override is None or override.is_sweep_override()
    value = None if override is None or swept else override.value()
    if key(argument) not in FOLDERS or not str(value).startswith("~"):
        return argument
    try:
        return f"{argument.partition('=')[0]}={quote(str(Path(str(value)).expanduser()))}"
    except RuntimeError:
        raise UserError(
            f"{argument}: no user has this name. For a folder, write ./{value}"
        ) from None


def as_typed(arguments: Any) -> list[str]:
    """Return a list of overrides with their interpolations as the user typed them.

    Args:
        arguments: of ``hydra.overrides``, where OmegaConf would resolve them among Hydra's own
            settings.
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
