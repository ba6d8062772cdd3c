"""The program: trains, or hands over to a subcommand.

Nothing heavy is imported before the command is known, so that ``--help`` is quick.
"""

import os
import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from mops_lightning.errors import USER_ERROR, did_you_mean, end, quiet_on_closed_pipe

COMMANDS = {
    "report": "mops_lightning.report.cli.main",
    "downsample": "mops_lightning.files.downsample_cli.downsample",
    "propagate": "mops_lightning.files.cli.propagate",
    "compare": "mops_lightning.files.cli.compare",
    "models": "mops_lightning.cli.models.main",
    "export": "mops_lightning.cli.models.export",
}
"""Subcommands and their functions of ``(arguments, prog)``."""

HELP_ALONE = (["--help"], ["-h"])
"""Command lines that are answered without Hydra."""

WORD = re.compile(r"[^-+~=][^=]*")
"""An argument that is neither an option nor an override."""

SPINS = "1000"
"""How often a thread of libgomp looks for work before it sleeps, by default 300,000 times.

On a machine that others use, too, threads that wait without sleeping hold the cores that the
threads they wait for need: beside two busy processes, two threads took four times as long as one.
"""


def main() -> None:
    """Run the subcommand that is the first argument; without one, train."""
    if "OMP_WAIT_POLICY" not in os.environ:  # libgomp reads both when torch is imported
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)
    arguments = sys.argv[1:]
    first = arguments[0] if arguments else ""
    with quiet_on_closed_pipe():
        if first == "--version":
            from importlib.metadata import version

            print(f"mops_lightning {version('mops-lightning')}")
        elif arguments in HELP_ALONE:
            from mops_lightning.config import help

            print(help.text())
        elif first in COMMANDS:
            subcommand = _function(COMMANDS[first])
            subcommand(arguments[1:], f"{program()} {first}")
        elif WORD.fullmatch(first):
            hint = did_you_mean(first, COMMANDS)
            end(
                "mops_lightning",
                f"{first!r} is neither a subcommand nor a setting.{hint} Settings are KEY=VALUE.",
                USER_ERROR,
            )
        else:
            from mops_lightning.cli import train

            train.main()


def _function(path: str) -> Callable[[list[str], str], None]:
    """Import the function that a dotted path names."""
    module, _, name = path.rpartition(".")
    function: Callable[[list[str], str], None] = getattr(import_module(module), name)
    return function


def program() -> str:
    """Return what the user typed to start this program."""
    name = Path(sys.argv[0]).name
    if name == "__main__.py":
        return "python -m mops_lightning"
    return name
