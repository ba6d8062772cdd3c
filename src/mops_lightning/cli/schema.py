"""The subcommand ``schema``."""

import argparse
import json
from pathlib import Path

from mops_lightning.errors import UserError, one_line_endings
from mops_lightning.files import atomic_write

DESCRIPTION = """Print a JSON schema of the configuration, for editors, or write it to OUT.

Editors with a YAML language server then complete and check settings in files that start with
# yaml-language-server: $schema=OUT"""


def main(arguments: list[str], prog: str) -> None:
    """Print or write the schema.

    Args:
        arguments: those of the command line.
        prog: what the user typed to start this command.
    """
    with one_line_endings(prog):
        chosen = make_parser(prog).parse_args(arguments)
        from mops_lightning.config.schema import schema

        text = json.dumps(schema(), ensure_ascii=False, separators=(",", ":"))
        if chosen.target is None:
            print(text)
            return
        _write(chosen.target, text)


def make_parser(prog: str) -> argparse.ArgumentParser:
    """Return the parser of this command's arguments."""
    parser = argparse.ArgumentParser(
        prog=prog, description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("target", metavar="OUT", nargs="?", type=Path, help="a file to (over)write")
    return parser


def _write(path: Path, text: str) -> None:
    try:
        with atomic_write(path) as temporary:
            temporary.write_text(text + "\n")
    except OSError as error:
        raise UserError(f"OUT: cannot write to {path}: {error.strerror}.") from None
    print(path)
