"""Arguments that several subcommands of files share."""

import argparse
from collections.abc import Callable

from mops_lightning.data.formats.bin_columns import parse_columns
from mops_lightning.errors import Parser

WEIGHTS = "a trained sampler: a model, a weights file, a run, or URL#sha256=HASH of a weights file"

COLUMNS = (
    "names of the columns of .bin files, all float32, such as x,y,z,intensity,ring; default: "
    "x,y,z,intensity, in .pcd.bin files also ring"
)

COMPARED = ("table.csv", "compare.html")
"""The files of a comparison."""

Add = Callable[..., object]
"""``ArgumentParser.add_argument``."""


def parsed(
    arguments: list[str], prog: str, description: str, declare: Callable[[Add], None]
) -> argparse.Namespace:
    """Parse the arguments of a subcommand, which ``declare`` adds to the parser."""
    parser = Parser(prog, description)
    declare(parser.add_argument)
    return parser.parse_args(arguments)


def columns_of(chosen: argparse.Namespace) -> tuple[str, ...] | None:
    """Return the names that ``--columns`` gives, or None."""
    return None if chosen.columns is None else parse_columns(chosen.columns)
