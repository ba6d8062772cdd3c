"""The command ``mops-lightning compare``."""

import argparse
from pathlib import Path

from mops_lightning.errors import UserError, did_you_mean, one_line_endings
from mops_lightning.zoo.names import UNTRAINED

DESCRIPTION = """Compare downsampling methods on your own files.

Each file is sampled to m points by random, voxel, farthest point and Poisson-disk sampling and,
with --weights, by a trained sampler. A table and a page with the clouds in 3-D show the chamfer and
Hausdorff distances to the full cloud, how evenly it is represented, and the time."""


def main(arguments: list[str] | None = None, prog: str = "mops-lightning compare") -> None:
    """Write the table and the page, and print the table.

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
    add("files", metavar="FILE", type=Path, nargs="+", help="clouds or meshes")
    add("--m", type=int, nargs="+", required=True, help="numbers of points to keep")
    add(
        "--weights", help="a trained sampler: a model's name, a weights file or the folder of a run"
    )
    add("--methods", nargs="+", default=list(UNTRAINED), help="untrained methods; default: all")
    add("--tile", type=int, metavar="POINTS", help="the trained sampler by tiles, as in downsample")
    add("--out", type=Path, default=Path("compare"), help="folder to write; default: compare")
    add("--seed", type=int, default=0, help="seed of random choices")
    add("--overwrite", action="store_true", help="replace an earlier comparison in --out")
    return parser


def _run(chosen: argparse.Namespace) -> None:
    if chosen.weights is None and chosen.tile is not None:
        raise UserError("--tile is for the trained sampler: give --weights.")
    for name in chosen.methods:
        if name not in UNTRAINED:
            raise UserError(f"--methods: unknown {name!r}.{did_you_mean(name, UNTRAINED)}")
    from mops_lightning.files.compare import (
        FILES,
        compare_file,
        options_by_method,
        write_comparison,
    )
    from mops_lightning.files.downsample import load_sampler

    _check_folder(chosen.out, FILES, chosen.overwrite)
    by_size = {
        m: options_by_method(m, chosen.methods, chosen.weights, chosen.tile, chosen.seed)
        for m in chosen.m
    }
    for methods in by_size.values():
        for options in methods.values():
            load_sampler(options)  # reports its mistakes before any file is read
    results = [
        compare_file(path, m, methods, chosen.seed)
        for path in chosen.files
        for m, methods in by_size.items()
    ]
    print(write_comparison(results, chosen.out))
    print(f"files in {chosen.out}/: {', '.join(FILES)}")


def _check_folder(folder: Path, written: tuple[str, ...], overwrite: bool) -> None:
    """Accept a new or empty folder, or with ``overwrite`` an earlier comparison.

    Raises:
        UserError: the folder contains other files, or an earlier comparison that is kept.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise UserError(f"--out must be a folder, got the file {folder}.")
    names = sorted(path.name for path in folder.iterdir())
    if other := next((name for name in names if name not in written), None):
        raise UserError(
            f"--out: {folder} contains {other}, which is not part of a comparison. Give a new "
            "folder."
        )
    if names and not overwrite:
        raise UserError(
            f"--out: {folder} contains an earlier comparison ({', '.join(names)}). Give another "
            "folder, or --overwrite."
        )
