"""Shell completion of subcommands and their options; Hydra completes settings.

Hydra's shell function calls ``PROGRAM -sc query=SHELL`` with the typed line in ``COMP_LINE``, and
takes every printed word as a candidate. Where nothing is printed, the shell completes files.
"""

import io
import os
from collections.abc import Iterable, Sequence
from importlib import import_module

from mops_lightning.cli.commands import COMMANDS


def is_query(arguments: Sequence[str]) -> bool:
    """Return whether a shell asks for candidates."""
    return (
        len(arguments) == 2
        and arguments[0] in ("-sc", "--shell-completion")
        and arguments[1].startswith("query=")
    )


def complete(line: str) -> bool:
    """Print candidates for the last word of a typed line.

    Args:
        line: starts with the program's name.

    Returns:
        Whether these are all candidates. Otherwise the word may be a setting.
    """
    words = line.split()
    if line[-1:].isspace():
        words.append("")
    if len(words) == 2:
        _print(name for name in COMMANDS if name.startswith(words[1]))
    if len(words) < 3 or words[1] not in COMMANDS:
        return False
    _print(_options(words[1], line))
    return True


def _print(candidates: Iterable[str]) -> None:
    for candidate in candidates:
        print(candidate)


def _options(name: str, line: str) -> list[str]:
    """Return the options, or the choices of the last option, that the line can continue with."""
    try:
        import argcomplete
    except ImportError:  # an extra
        return []
    found = io.StringIO()
    # argcomplete is configured by these. 2: the program's name has two words.
    os.environ |= {"_ARGCOMPLETE": "2", "_ARGCOMPLETE_IFS": "\n", "COMP_POINT": str(len(line))}
    argcomplete.autocomplete(
        import_module(COMMANDS[name].module).make_parser(name),
        always_complete_options=False,
        exit_method=lambda _: None,
        output_stream=found,
        append_space=False,
        default_completer=argcomplete.SuppressCompleter(),
    )
    return found.getvalue().split()
