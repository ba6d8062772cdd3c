"""The command ``mops-lightning compare``."""

import argparse
from pathlib import Path

from mops_lightning.compare.methods import FILES, methods
from mops_lightning.downsample_files.settings import METHODS
from mops_lightning.errors import UserError, did_you_mean, one_line_endings

DESCRIPTION = """Compare methods of downsampling on your own files.

Each file is sampled to m points by random, voxel, farthest point and Poisson-disk sampling and,
with --weights, by a trained sampler. A table and a page with the clouds in 3-D show the distances
to the full cloud and to its thin parts, how evenly it is represented, the errors of attributes and
normals, time and memory."""

METHODS_HELP = "untrained methods; default: all. fps is always there, as the scale of thin parts"


def main(
    arguments: list[str] | None = None, prog: str = "python -m mops_lightning.compare"
) -> None:
    """Write the table and the page, and print the table.

    Args:
        arguments: those of the command line; None: ``sys.argv``.
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
    add("files", metavar="FILE", type=Path, nargs="+", help="clouds or meshes")
    add("--m", type=int, nargs="+", required=True, help="numbers of points to keep")
    add("--weights", help="a trained sampler: a model's name, a weights.pt or the folder of a run")
    add("--methods", nargs="+", default=list(METHODS), help=METHODS_HELP)
    add("--tile", type=int, metavar="POINTS", help="the trained sampler by tiles, as in downsample")
    add("--tile-size", type=float, metavar="SIDE", help="the same with cubes")
    add("--out", type=Path, default=Path("compare"), help="folder to write; default: compare")
    add("--seed", type=int, default=0, help="seed of random choices")
    add("--overwrite", action="store_true", help="replace an earlier comparison in --out")
    return parser


def _run(chosen: argparse.Namespace) -> None:
    if chosen.weights is None and (chosen.tile is not None or chosen.tile_size is not None):
        raise UserError("--tile and --tile-size are for the trained sampler: give --weights.")
    for name in chosen.methods:
        if name not in METHODS:
            raise UserError(f"--methods: unknown {name!r}.{did_you_mean(name, METHODS)}")
    if chosen.out.exists() and not chosen.out.is_dir():
        raise UserError(f"--out must be a folder, got the file {chosen.out}.")
    _refuse_earlier(chosen.out, chosen.overwrite)
    tiles = chosen.tile, chosen.tile_size
    sizes = {m: methods(m, chosen.methods, chosen.weights, *tiles, chosen.seed) for m in chosen.m}
    from mops_lightning.compare.result import compared, write
    from mops_lightning.downsample_files.job import sampler_of

    for one in sizes.values():
        for settings in one.values():
            sampler_of(settings)  # reports its mistakes before any file is read
    print(write(compared(chosen.files, sizes, chosen.seed), chosen.out))
    print(f"files in {chosen.out}/: {', '.join(FILES)}")


def _refuse_earlier(folder: Path, overwrite: bool) -> None:
    """Keep the files of an earlier comparison.

    Raises:
        UserError: there are some.
    """
    found = [name for name in FILES if (folder / name).exists()]
    if found and not overwrite:
        raise UserError(
            f"--out: {folder} contains an earlier comparison ({', '.join(found)}). Give another "
            "folder, or --overwrite."
        )
