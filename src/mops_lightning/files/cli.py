"""The subcommands ``downsample``, ``propagate`` and ``compare``."""

import argparse
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from os.path import realpath
from pathlib import Path

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.bin_columns import parse_columns
from mops_lightning.errors import Parser, UserError, did_you_mean, one_line_endings, printable
from mops_lightning.files.engine import Engine
from mops_lightning.files.options import Options
from mops_lightning.filesystem import remove_temporary
from mops_lightning.records.readout_names import GENERATED_READOUTS
from mops_lightning.zoo.names import UNTRAINED

DOWNSAMPLE = """Downsample clouds and meshes from files.

IN is a file (.ply .pcd .las .laz .bin .npy .npz .xyz .txt .e57 .pts .ptx .spz, or a mesh: .off
.obj .stl .glb), a folder of them, a pattern such as 'county/*.laz', or the web address of a COPC
file, of which an area is read. OUT is a file (.ply .pcd .las .laz .bin .npy .npz .xyz .txt) or a
folder. Clouds are normalised to the unit sphere, as in training, sampled by a trained sampler
(--weights) or an untrained method (--method), and mapped back. Meshes are first sampled on their
surface."""

PROPAGATE = """Carry labels, colours or scores from a sample to all points of a cloud.

SMALL is the sample with the columns, BIG the whole cloud (.ply .pcd .las .laz .bin .npy .npz .xyz
.txt). Every point of BIG gets the values of its nearest point of SMALL. A .las, .laz, .npy, .bin or
binary .ply file may be larger than memory."""

COMPARE = """Compare downsampling methods on your own files.

Each file is sampled to m points by random, voxel, farthest point and Poisson-disk sampling and,
with --weights, by a trained sampler. A table and a page with the clouds in 3-D show the chamfer and
Hausdorff distances to the full cloud, how evenly it is represented, and the time."""

WEIGHTS = "a trained sampler: a model, a weights file, a run, or URL#sha256=HASH of a weights file"

COLUMNS = (
    "names of the columns of .bin files, all float32, such as x,y,z,intensity,ring; default: "
    "x,y,z,intensity, in .pcd.bin files also ring"
)

Add = Callable[..., object]
"""``ArgumentParser.add_argument``."""


def parsed(
    arguments: list[str], prog: str, description: str, declare: Callable[[Add], None]
) -> argparse.Namespace:
    """Parse the arguments of a subcommand, which ``declare`` adds to the parser."""
    parser = Parser(prog, description)
    declare(parser.add_argument)
    return parser.parse_args(arguments)


def downsample(arguments: list[str], prog: str = "mops-lightning downsample") -> None:
    """Downsample all files; failed files are listed at the end and make the exit status 1.

    Args:
        arguments: of the command line.
        prog: what the user typed to start this command.
    """
    with one_line_endings(prog, "interrupted. Run the same command to do the rest."):
        sys.exit(_downsample(parsed(arguments, prog, DOWNSAMPLE, _downsample_arguments)))


def _downsample_arguments(add: Add) -> None:
    add("source", metavar="IN", help="a file, a folder, a pattern, or the address of a COPC file")
    add("target", metavar="OUT", type=Path, help="a file or a folder")
    add("--m", type=int, help="number of points to keep; default: as the weights were trained for")
    add("--weights", help=WEIGHTS)
    add("--method", choices=UNTRAINED, help="an untrained method, instead of --weights")
    add(
        "--readout",
        choices=GENERATED_READOUTS,
        help="of a trained sampler: the points that it generates, the input points nearest to "
        "them, or these without duplicates, completed to m by farthest point sampling (default)",
    )
    add(
        "--coordinates-only",
        action="store_true",
        help="leave out colours, normals, intensities and the like, which are kept by default",
    )
    add("--surface", type=int, help="points to sample from a mesh first; default: 10000 or 8m")
    add("--vertices", action="store_true", help="of a mesh: its vertices, not its surface")
    add("--columns", metavar="X,Y,Z,...", help=COLUMNS)
    add("--workers", type=int, default=1, help="processes that share a folder's files")
    add(
        "--tile",
        type=int,
        metavar="POINTS",
        help="cut large scenes into tiles of up to so many points (a balanced kd-tree), sample "
        "each as in training, and keep --m points in total",
    )
    add(
        "--chunk",
        type=int,
        metavar="POINTS",
        help="for clouds larger than memory: MOPS-Net's generated and matched points are computed "
        "from all points, so many at a time; everything else samples so many random points",
    )
    add(
        "--cluster",
        metavar="ADDRESS",
        help="distribute the chunks of every file over the workers of this Dask scheduler",
    )
    add(
        "--map",
        type=Path,
        metavar="FILE.npz",
        help="write for every point of IN the row of its nearest point of OUT, to carry labels "
        "back by mops_lightning.propagate",
    )
    add("--map-k", type=int, default=1, help="rows per point in --map, with weights 1/d^2")
    add(
        "--weight",
        metavar="FIELD",
        help="prefer points by this column of IN, such as opacity or intensity, or by 'curvature', "
        "which is computed; with --method fps, random, poisson, or --readout completed",
    )
    add(
        "--bounds",
        metavar="XMIN,YMIN[,ZMIN],XMAX,YMAX[,ZMAX]",
        help="sample the points in this box only, in the file's unit; of a COPC file, only the "
        "cells of its octree that overlap the box are read",
    )
    add("--level", type=int, help="of a COPC file: deepest level of its octree to read; 0: root")
    add(
        "--resolution",
        type=float,
        metavar="DISTANCE",
        help="of a COPC file: read the levels down to this distance of neighbouring points",
    )
    add("--seed", type=int, default=0, help="seed of random choices")
    add("--overwrite", action="store_true", help="replace existing files")


def _downsample(chosen: argparse.Namespace) -> int:
    """Do what the arguments say and return the exit status."""
    options = _options(chosen)
    from mops_lightning.data.formats.remote import local
    from mops_lightning.files.downsample import load_sampler

    load_sampler(options)  # reports its mistakes before any file is read
    with local(chosen.source, options.area) as chosen.source:
        return _downsample_files(chosen, options)


def _downsample_files(chosen: argparse.Namespace, options: Options) -> int:
    from mops_lightning.files.batch import file_pairs, is_many, process_file, process_folder

    if chosen.cluster:  # workers may have a different working directory
        chosen.source = chosen.source.absolute()
    pairs = file_pairs(chosen.source, chosen.target)
    is_folder = is_many(chosen.source)
    if options.columns and not any(source.suffix.lower() == ".bin" for source, _ in pairs):
        raise UserError(f"--columns is for .bin files, got {chosen.source}.")
    if not is_folder and pairs[0][1].exists() and not chosen.overwrite:
        raise UserError(f"{pairs[0][1]} exists. Give another OUT, or --overwrite.")
    if chosen.map is not None:
        _check_map(chosen, is_folder, pairs[0])
    # Of a run that was killed.
    remove_temporary(chosen.target if is_folder else pairs[0][1].parent, below=is_folder)
    with _engine(chosen, not is_folder) as engine:
        if not is_folder:
            process_file(*pairs[0], options, engine)
            return 0
        workers, overwrite = chosen.workers, chosen.overwrite
        failed = process_folder(pairs, options, chosen.target, workers, overwrite, engine)
        return 1 if failed else 0


def _check_map(chosen: argparse.Namespace, is_folder: bool, files: tuple[Path, Path]) -> None:
    """Reject a map of several files, and one that would replace another file."""
    if is_folder:
        raise UserError(f"--map is the map of one file, but IN is {chosen.source}.")
    if realpath(chosen.map) in map(realpath, files):
        raise UserError(f"--map must differ from IN and OUT, got {chosen.map}.")
    if chosen.map.exists() and not chosen.overwrite:
        raise UserError(f"{chosen.map} exists. Give another --map, or --overwrite.")


def _options(chosen: argparse.Namespace) -> Options:
    if chosen.readout and chosen.method:
        raise UserError(f"--readout needs --weights: --method {chosen.method} keeps input points.")
    if chosen.workers < 1:
        raise UserError(f"--workers must be at least 1, got {chosen.workers}.")
    if chosen.cluster == "":
        raise UserError("--cluster must be the address of a Dask scheduler, got ''.")
    if chosen.cluster and "://" in chosen.source:
        raise UserError("--cluster: the workers do not see a copy from the web. Download the file.")
    if chosen.cluster and chosen.chunk is None:
        raise UserError("--cluster distributes the chunks of a file: give --chunk as well.")
    chosen.columns = _columns(chosen)
    chosen.area = Area.parse(chosen.bounds, chosen.level, chosen.resolution)
    values = {field.name: getattr(chosen, field.name) for field in fields(Options)}
    return Options(**{**values, "readout": chosen.readout or "completed"})


def _columns(chosen: argparse.Namespace) -> tuple[str, ...] | None:
    return None if chosen.columns is None else parse_columns(chosen.columns)


def _engine(chosen: argparse.Namespace, is_file: bool) -> AbstractContextManager[Engine | None]:
    """Return the engine; None for a folder without ``--cluster``: its files are shared."""
    if not chosen.cluster:
        return nullcontext(Engine(progress=True) if is_file else None)
    from mops_lightning.files.engine import dask_engine

    return dask_engine(chosen.cluster, progress=is_file)


def propagate(arguments: list[str], prog: str = "mops-lightning propagate") -> None:
    """Carry columns of one file to another; arguments as for ``downsample``."""
    with one_line_endings(prog):
        _propagate(parsed(arguments, prog, PROPAGATE, _propagate_arguments))


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

    big, target = chosen.big, chosen.target
    check_is_file(big)
    if target is None:
        suffix = big.suffix if big.suffix.lower() in PART_WRITERS else ".ply"
        stem = big.stem.removesuffix(".copc")  # a COPC file would sort the points
        target = big.with_name(f"{stem}_propagated{suffix}")
    if target.suffix.lower() not in PART_WRITERS:
        raise UserError(f"OUT must end in {', '.join(PART_WRITERS)}, got {target}.")
    if realpath(target) in (realpath(big), realpath(chosen.small)):
        raise UserError(f"OUT must differ from SMALL and BIG, got {target}.")
    if target.exists() and not chosen.overwrite:
        raise UserError(f"{target} exists. Give another OUT, or --overwrite.")
    remove_temporary(target.parent, below=False)
    columns = _columns(chosen)
    number = propagate_file(chosen.small, big, target, chosen.field, chosen.k, chosen.mean, columns)
    names, seconds = ", ".join(chosen.field), time.perf_counter() - start
    print(printable(f"{target}: {names} of {number:,} points, {seconds:.1f} s"))


def compare(arguments: list[str], prog: str = "mops-lightning compare") -> None:
    """Write the table and the page, and print the table; arguments as for ``downsample``."""
    with one_line_endings(prog):
        _compare(parsed(arguments, prog, COMPARE, _compare_arguments))


def _compare_arguments(add: Add) -> None:
    add("files", metavar="FILE", type=Path, nargs="+", help="clouds or meshes")
    add("--m", type=int, nargs="+", required=True, help="numbers of points to keep")
    add("--weights", help=WEIGHTS)
    add("--methods", nargs="+", default=list(UNTRAINED), help="untrained methods; default: all")
    add("--tile", type=int, metavar="POINTS", help="the trained sampler by tiles, as in downsample")
    add("--out", type=Path, default=Path("compare"), help="folder to write; default: compare")
    add("--seed", type=int, default=0, help="seed of random choices")
    add("--overwrite", action="store_true", help="replace an earlier comparison in --out")


def _compare(chosen: argparse.Namespace) -> None:
    if chosen.weights is None and chosen.tile is not None:
        raise UserError("--tile is for the trained sampler: give --weights.")
    for name in chosen.methods:
        if name not in UNTRAINED:
            raise UserError(f"--methods: unknown {name!r}.{did_you_mean(name, UNTRAINED)}")
    from mops_lightning.files import compare as comparison
    from mops_lightning.files.downsample import load_sampler

    if chosen.out.exists() and not chosen.out.is_dir():
        raise UserError(f"--out must be a folder, got the file {chosen.out}.")
    found = {path.name for path in chosen.out.glob("[!.]*")}
    if other := sorted(found.difference(comparison.FILES)):
        raise UserError(f"--out: {chosen.out} has other files, such as {other[0]}. Give a new one.")
    if found and not chosen.overwrite:
        raise UserError(f"--out: {chosen.out / max(found)} exists. Give another, or --overwrite.")
    by_size = {
        m: comparison.options_by_method(m, chosen.methods, chosen.weights, chosen.tile, chosen.seed)
        for m in chosen.m
    }
    for methods in by_size.values():
        for options in methods.values():
            load_sampler(options)  # reports its mistakes before any file is read
    results = [
        comparison.compare_file(path, m, methods, chosen.seed)
        for path in chosen.files
        for m, methods in by_size.items()
    ]
    print(comparison.write_comparison(results, chosen.out))
    print(f"files in {chosen.out}/: {', '.join(comparison.FILES)}")
