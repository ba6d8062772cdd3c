"""Arguments that several subcommands of files share."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from mops_lightning.data.formats.bin_columns import parse_columns
from mops_lightning.errors import Parser, UserError

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
    arguments: list[str],
    prog: str,
    description: str,
    declare: Callable[[Add], None],
) -> argparse.Namespace:
    """Parse the arguments of a subcommand, which ``declare`` adds to the parser."""
    parser = Parser(prog, description)
    declare(parser.add_argument)
    return parser.parse_args(arguments)


def columns_of(chosen: argparse.Namespace) -> tuple[str, ...] | None:
    """Return the names that ``--columns`` gives, or None."""
    if chosen.columns is None:
        return None
    return parse_columns(chosen.columns)


def numbers(text: str) -> list[int]:
    """Return the whole numbers in a word of the command line, such as ``8`` or ``8,16,32``."""
    words = [word for word in text.split(",") if word.strip()]
    return [int(word) for word in words]


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, such as ``1 point`` or ``1,200 points``."""
    if number == 1:
        return f"{number:,} {noun}"
    return f"{number:,} {noun}s"


def one_of(weights: Sequence[str] | None) -> str | None:
    """Return the only trained sampler, or None.

    Raises:
        UserError: there are several.
    """
    if weights and len(weights) > 1:
        raise UserError(f"several --weights are for --task-net, got {', '.join(weights)}.")
    if not weights:
        return None
    return weights[0]


def check_out(folder: Path, overwrite: bool, written: Sequence[str] = COMPARED) -> None:
    """Check that a comparison may be written to a folder.

    Args:
        folder: the folder; it need not exist.
        overwrite: whether an earlier comparison may be replaced.
        written: names of the files that are written.

    Raises:
        UserError: it is a file, or has other files, or an earlier comparison.
    """
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--out must be a folder, got the file {folder}.")
    found = {path.name for path in folder.glob("[!.]*")}
    others = sorted(found.difference(written))
    if others:
        raise UserError(f"--out: {folder} has other files, such as {others[0]}. Give a new one.")
    if found and not overwrite:
        last = folder / max(found)
        raise UserError(f"--out: {last} exists. Give another, or --overwrite.")
