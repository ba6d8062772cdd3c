"""Reading overrides such as ``++task/net@task.net=pcrnet`` with Hydra's own parser."""

from functools import cache
from typing import TYPE_CHECKING

from mops_lightning.config import settings

if TYPE_CHECKING:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import Override


def parse(argument: str) -> "Override | None":
    """Read one argument of the command line.

    A value that is none to Hydra, such as a path with ``=`` in it, is taken as the text it is.

    Returns:
        None for an option and for what is no override at all.
    """
    return None if argument.startswith("-") else _parsed(argument) or _parsed(_quoted(argument))


def readable(argument: str) -> str:
    """Return an override in a form that Hydra reads, with its value quoted if need be."""
    return argument if _parsed(argument) else _quoted(argument)


def key(argument: str) -> str:
    """Return the key that an override is about, such as ``task/net``; empty for anything else."""
    override = parse(argument)
    if override is None:
        return ""
    package = f"@{override.package}" if override.package is not None else ""
    return f"{override.key_or_group}{package}"


def path(argument: str) -> str:
    """Return the dotted place in the configuration that an override changes."""
    name, _, package = key(argument).partition("@")
    return package or name.replace("/", ".")


def accepted(argument: str) -> str:
    """Return an argument as Hydra accepts it.

    With a ``+`` before a setting that no file contains, and with quotes around a value that is none
    to Hydra, such as a path with ``=`` in it.
    """
    name = key(argument)
    if not name:
        return argument
    missing = name in settings.ON_DEMAND and argument[0] not in "+~"
    return f"+{readable(argument)}" if missing else readable(argument)


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
