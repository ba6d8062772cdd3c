"""The subcommand ``propagate``."""

import argparse
import time
from os.path import realpath
from pathlib import Path

from mops_lightning.errors import UserError, one_line_endings, printable
from mops_lightning.filesystem import remove_temporary

DESCRIPTION = """Carry labels, colours or scores from a sample to all points of a cloud.

SMALL is the sample with the columns, BIG the whole cloud (.ply .pcd .las .laz .bin .npy .npz .xyz
.txt). Every point of BIG gets the values of its nearest point of SMALL. A .las, .laz, .npy, .bin or
binary .ply file may be larger than memory."""


def main(arguments: list[str] | None = None, prog: str = "mops-lightning propagate") -> None:
    """Carry columns of one file to another.

    Args:
        arguments: of the command line; None: ``sys.argv``.
        prog: what the user typed to start this command.
    """
    with one_line_endings(prog):
        _run(make_parser(prog).parse_args(arguments))


def make_parser(prog: str) -> argparse.ArgumentParser:
    """Return the parser of this command's arguments."""
    parser = argparse.ArgumentParser(
        prog=prog, description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("small", metavar="SMALL", type=Path, help="the sample, with the columns")
    add("big", metavar="BIG", type=Path, help="all points")
    add(
        "target",
        metavar="OUT",
        type=Path,
        nargs="?",
        help="a .ply, .las or .laz file to write; default: BIG_propagated",
    )
    add(
        "--field",
        action="append",
        required=True,
        metavar="NAME",
        help="a column of SMALL; may be given several times. It replaces a column of BIG",
    )
    add(
        "--k",
        type=int,
        default=1,
        help="use the k nearest points of SMALL, weighted by 1/d^2: floats are averaged, of whole "
        "numbers the one with the largest weight is taken; default: 1, which copies",
    )
    add("--mean", action="store_true", help="with --k: average whole numbers, such as colours")
    add("--overwrite", action="store_true", help="replace an existing OUT")
    return parser


def _run(chosen: argparse.Namespace) -> None:
    start = time.perf_counter()
    from mops_lightning.data.formats.registry import PART_WRITERS
    from mops_lightning.files.propagate import propagate_file

    big, target = chosen.big, chosen.target
    if target is None:
        suffix = big.suffix if big.suffix.lower() in PART_WRITERS else ".ply"
        target = big.with_name(f"{big.stem}_propagated{suffix}")
    if target.suffix.lower() not in PART_WRITERS:
        raise UserError(f"OUT must end in {', '.join(PART_WRITERS)}, got {target}.")
    if realpath(target) in (realpath(big), realpath(chosen.small)):
        raise UserError(f"OUT must differ from SMALL and BIG, got {target}.")
    if target.exists() and not chosen.overwrite:
        raise UserError(f"{target} exists. Give another OUT, or --overwrite.")
    remove_temporary(target.parent, below=False)
    number = propagate_file(chosen.small, big, target, chosen.field, chosen.k, chosen.mean)
    names, seconds = ", ".join(chosen.field), time.perf_counter() - start
    print(printable(f"{target}: {names} of {number:,} points, {seconds:.1f} s"))
