"""The program: trains, or hands over to a subcommand.

Nothing heavy is imported before the command is known, so that ``--help`` is quick.
"""

import re
import sys
from importlib import import_module
from pathlib import Path

from mops_lightning.errors import USER_ERROR, did_you_mean, end, quiet_on_closed_pipe

COMMANDS = {
    "report": "mops_lightning.report.cli",
    "downsample": "mops_lightning.downsample.cli",
}
"""Subcommands and their modules, each with ``main(arguments, prog)``."""


def main() -> None:
    """Run the subcommand that is the first argument; without one, train."""
    first = sys.argv[1] if len(sys.argv) > 1 else ""
    with quiet_on_closed_pipe():
        if first in COMMANDS:
            command = import_module(COMMANDS[first])
            command.main(sys.argv[2:], f"{program()} {first}")
        elif re.match("[^-+~=][^=]*$", first):
            hint = did_you_mean(first, COMMANDS)
            end(
                "mops_lightning",
                f"{first!r} is neither a subcommand nor a setting.{hint} Settings are KEY=VALUE.",
                USER_ERROR,
            )
        else:
            from mops_lightning.cli import train

            train.main()


def program() -> str:
    """Return what the user typed to start this program."""
    name = Path(sys.argv[0]).name
    return "python -m mops_lightning" if name == "__main__.py" else name
