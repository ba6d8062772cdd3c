"""The subcommands ``propagate`` and ``compare``."""

import argparse
import time
from collections.abc import Sequence
from os.path import realpath
from pathlib import Path

from mops_lightning.errors import UserError, did_you_mean, one_line_endings, printable
from mops_lightning.files.arguments import (
    COLUMNS,
    COMPARED,
    WEIGHTS,
    Add,
    check_out,
    columns_of,
    counted,
    numbers,
    one_of,
    parsed,
)
from mops_lightning.files.icp.cli import ONLY_ICP, compare_icp
from mops_lightning.files.icp.cli import add_arguments as add_icp_arguments
from mops_lightning.files.task_net.cli import ONLY_TASK_NET, compare_by_net
from mops_lightning.files.task_net.cli import add_arguments as add_task_net_arguments
from mops_lightning.filesystem import remove_temporary
from mops_lightning.zoo.names import UNTRAINED

PROPAGATE = """Carry labels, colours or scores from a sample to all points of a cloud.

SMALL is the sample with the columns, BIG the whole cloud (.ply .pcd .las .laz .bin .npy .npz .xyz
.txt). Every point of BIG gets the values of its nearest point of SMALL. A .las, .laz, .npy, .bin or
binary .ply file may be larger than memory."""

COMPARE = """Compare downsampling methods on your own files.

Each file is sampled to m points by every untrained method and, with --weights, by a trained
sampler. A table and a page with the clouds in 3-D show the chamfer and
Hausdorff distances to the full cloud, how evenly it is represented, and the time.

With --task-net RUN, FILES may be folders. The table shows the score and the loss of a trained task
net from m points of every method, over five draws of crops. The last line says which method to use
for how many points; --save keeps it as a sampler for `downsample --weights`.

With --task icp, FILE is one folder of scans. Halves of random crops, or with --poses consecutive
frames, are aligned by small_gicp from m points of every method. The table shows the error of the
rotation over ten draws, and the times."""

DRAWN = ("draws", "crops", "points")
"""Options of comparisons that draw crops."""


def propagate(arguments: list[str], prog: str = "mops-lightning propagate") -> None:
    """Carry columns of one file to another; arguments as for ``downsample``."""
    with one_line_endings(prog):
        chosen = parsed(arguments, prog, PROPAGATE, _propagate_arguments)
        _propagate(chosen)


def _propagate_arguments(add: Add) -> None:
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
    add("--columns", metavar="X,Y,Z,...", help=COLUMNS)
    add("--mean", action="store_true", help="with --k: average whole numbers, such as colours")
    add("--overwrite", action="store_true", help="replace an existing OUT")


def _propagate(chosen: argparse.Namespace) -> None:
    start = time.perf_counter()
    from mops_lightning.data.formats.guard import check_is_file
    from mops_lightning.data.formats.registry import PART_WRITERS
    from mops_lightning.files.propagate import propagate_file

    big = chosen.big
    target = chosen.target
    check_is_file(big)
    if target is None:
        suffix = ".ply"
        if big.suffix.lower() in PART_WRITERS:
            suffix = big.suffix
        stem = big.stem.removesuffix(".copc")  # a COPC file would sort the points
        target = big.with_name(f"{stem}_propagated{suffix}")
    if target.suffix.lower() not in PART_WRITERS:
        endings = ", ".join(PART_WRITERS)
        raise UserError(f"OUT must end in {endings}, got {target}.")
    if realpath(target) in (realpath(big), realpath(chosen.small)):
        raise UserError(f"OUT must differ from SMALL and BIG, got {target}.")
    if target.exists() and not chosen.overwrite:
        raise UserError(f"{target} exists. Give another OUT, or --overwrite.")
    remove_temporary(target.parent, below=False)
    columns = columns_of(chosen)
    number = propagate_file(
        chosen.small,
        big,
        target,
        chosen.field,
        chosen.k,
        chosen.mean,
        columns,
    )
    names = ", ".join(chosen.field)
    points = counted(number, "point")
    seconds = time.perf_counter() - start
    print(printable(f"{target}: {names} of {points}, {seconds:.1f} s"))


def compare(arguments: list[str], prog: str = "mops-lightning compare") -> None:
    """Write the table and the page, and print the table; arguments as for ``downsample``."""
    with one_line_endings(prog):
        _compare(compare_arguments(arguments, prog))


def compare_arguments(arguments: list[str], prog: str) -> argparse.Namespace:
    """Parse the arguments of ``compare``."""
    return parsed(arguments, prog, COMPARE, _compare_arguments)


def _compare_arguments(add: Add) -> None:
    add(
        "files",
        metavar="FILE",
        type=Path,
        nargs="+",
        help="clouds or meshes; icp: one folder; --task-net: files and folders",
    )
    add(
        "--task",
        choices=("coverage", "icp"),
        default="coverage",
        help="what is measured: distances to the whole cloud (default), or registration",
    )
    add(
        "--m",
        type=numbers,
        nargs="+",
        required=True,
        metavar="NUMBER",
        help="numbers of points to keep, such as 8,16,32",
    )
    add("--weights", action="append", help=f"{WEIGHTS}; --task-net: may be given several times")
    add("--methods", nargs="+", help="untrained methods; default: all")
    add("--columns", metavar="X,Y,Z,...", help=COLUMNS)
    add("--tile", type=int, metavar="POINTS", help="the trained sampler by tiles, as in downsample")
    add("--out", type=Path, default=Path("compare"), help="folder to write; default: compare")
    add("--seed", type=int, default=0, help="seed of random choices")
    add("--overwrite", action="store_true", help="replace an earlier comparison in --out")
    add(
        "--draws",
        type=int,
        metavar="N",
        help="icp, --task-net: draws of crops and random choices; default: 10, --task-net 5",
    )
    add(
        "--crops",
        type=int,
        metavar="N",
        help="icp, --task-net: crops of every file and draw; default: 32, --task-net 8, or 1 for a "
        "net of whole clouds",
    )
    add(
        "--points",
        type=int,
        metavar="N",
        help="icp, --task-net: points of a crop; default: 1024, --task-net as in training",
    )
    add_task_net_arguments(add)
    add_icp_arguments(add)


def _compare(chosen: argparse.Namespace) -> None:
    chosen.m = [m for word in chosen.m for m in word]
    if not chosen.m:
        raise UserError("--m must be numbers of points, such as 8,16,32.")
    if not 0 <= chosen.seed < 2**63:
        raise UserError(f"--seed must be from 0 to 2**63 - 1, got {chosen.seed}.")
    if chosen.weights is None and chosen.tile is not None:
        raise UserError("--tile is for the trained sampler: give --weights.")
    is_icp = chosen.task == "icp"
    if chosen.task_net is not None:
        if is_icp:
            raise UserError("--task-net scores its own task: leave --task out.")
        _refuse(chosen, ONLY_ICP, "--task icp")
        compare_by_net(chosen)
        return
    _refuse(chosen, ONLY_TASK_NET, "--task-net")
    if not is_icp:
        _refuse(chosen, (*ONLY_ICP, *DRAWN), "--task icp")
    check_out(chosen.out, chosen.overwrite)
    if is_icp:
        table = compare_icp(chosen)
    else:
        table = _compare_coverage(chosen)
    print(table)
    files = ", ".join(COMPARED)
    print(f"files in {chosen.out}/: {files}")


def _refuse(chosen: argparse.Namespace, options: Sequence[str], of: str) -> None:
    """Reject options that have no effect.

    Raises:
        UserError: one of them is given.
    """
    for name in options:
        if getattr(chosen, name) is not None:
            option = name.replace("_", "-")
            raise UserError(f"--{option} is for {of}.")


def _compare_coverage(chosen: argparse.Namespace) -> str:
    """Measure distances to the whole clouds, and return the table as text."""
    weights = one_of(chosen.weights)
    names = chosen.methods or list(UNTRAINED)
    for name in names:
        if name not in UNTRAINED:
            hint = did_you_mean(name, UNTRAINED)
            raise UserError(f"--methods: unknown {name!r}.{hint}")
    columns = columns_of(chosen)
    suffixes = {path.suffix.lower() for path in chosen.files}
    if columns and ".bin" not in suffixes:
        raise UserError("--columns is for .bin files, got none.")
    from mops_lightning.files import compare as comparison
    from mops_lightning.files.downsample import load_sampler

    by_size = {}
    for m in chosen.m:
        by_size[m] = comparison.options_by_method(m, names, weights, chosen.tile, chosen.seed)
    for methods in by_size.values():
        for options in methods.values():
            load_sampler(options)  # reports its mistakes before any file is read
    results = []
    for path in chosen.files:
        for m, methods in by_size.items():
            compared = comparison.compare_file(path, m, methods, chosen.seed, columns)
            results.append(compared)
    return comparison.write_comparison(results, chosen.out)
