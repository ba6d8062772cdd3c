"""The subcommand ``downsample``."""

import argparse
import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from os.path import realpath
from pathlib import Path
from typing import Any

from mops_lightning.data.formats.area import Area
from mops_lightning.errors import UserError, one_line_endings
from mops_lightning.files.arguments import COLUMNS, WEIGHTS, Add, columns_of, parsed
from mops_lightning.files.engine import Engine
from mops_lightning.files.options import Options, parse_distance, parse_size, parse_space
from mops_lightning.files.strata import Strata
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


def downsample(arguments: list[str], prog: str = "mops-lightning downsample") -> None:
    """Downsample all files; failed files are listed at the end and make the exit status 1.

    Args:
        arguments: of the command line.
        prog: what the user typed to start this command.
    """
    with one_line_endings(prog, "interrupted. Run the same command to do the rest."):
        chosen = parsed(arguments, prog, DOWNSAMPLE, _downsample_arguments)
        sys.exit(_downsample(chosen))


def _budget_arguments(add: Add) -> None:
    add(
        "--m",
        metavar="NUMBER|SHARE%",
        help="number of points to keep, or their share such as 10%%; default: as the weights were "
        "trained for",
    )
    add(
        "--spacing",
        metavar="DISTANCE",
        help="instead of --m: keep points of which no two are nearer, and to which every other "
        "point is nearer; in the file's unit",
    )
    add(
        "--voxel",
        metavar="SIZE",
        help="instead of --m: keep of every cubic voxel the point nearest to the mean of its "
        "points, or with --readout generated the mean; in the file's unit",
    )
    add("--total", action="store_true", help="of a folder: --m is for all files together")
    add(
        "--stratify",
        metavar="COLUMN:RULE",
        help="with --m: every class keeps its share (class:share), or at least so many points "
        "where it has them (class:min=50)",
    )
    add(
        "--space",
        metavar="COLUMN[=FACTOR],...",
        help="columns that count in distances beside x, y and z, scaled, such as intensity=0.01; "
        "with --method fps or poisson, and --spacing",
    )


def _downsample_arguments(add: Add) -> None:
    add("source", metavar="IN", help="a file, a folder, a pattern, or the address of a COPC file")
    add("target", metavar="OUT", type=Path, help="a file or a folder")
    _budget_arguments(add)
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
    _piece_arguments(add)
    _map_arguments(add)
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


def _piece_arguments(add: Add) -> None:
    """Add what divides files, and clouds that are large, into pieces of work."""
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


def _map_arguments(add: Add) -> None:
    add(
        "--map",
        type=Path,
        metavar="FILE.npz",
        help="write for every point of IN the row of its nearest point of OUT, to carry labels "
        "back by mops_lightning.propagate",
    )
    add("--map-k", type=int, default=1, help="rows per point in --map, with weights 1/d^2")


def _downsample(chosen: argparse.Namespace) -> int:
    """Do what the arguments say and return the exit status."""
    options = _options(chosen)
    from mops_lightning.data.formats.remote import local

    if not options.is_by_distance:
        from mops_lightning.files.downsample import load_sampler

        load_sampler(options)  # reports its mistakes before any file is read
    with local(chosen.source, options.area) as chosen.source:
        return _downsample_files(chosen, options)


def _downsample_files(chosen: argparse.Namespace, options: Options) -> int:
    from mops_lightning.files.batch import find_inputs, is_many, process_file, process_folder

    if chosen.cluster:  # workers may have a different working directory
        chosen.source = chosen.source.absolute()
    inputs = find_inputs(chosen.source, chosen.target)
    is_folder = is_many(chosen.source)
    source, target = inputs.pairs[0]
    suffixes = {path.suffix.lower() for path, _ in inputs.pairs}
    if options.columns and ".bin" not in suffixes:
        raise UserError(f"--columns is for .bin files, got {chosen.source}.")
    if chosen.total and not is_folder:
        raise UserError(f"--total is for a folder, got the file {chosen.source}.")
    if not is_folder and target.exists() and not chosen.overwrite:
        raise UserError(f"{target} exists. Give another OUT, or --overwrite.")
    if chosen.map is not None:
        _check_map(chosen, is_folder, (source, target))
    folder = target.parent
    if is_folder:
        folder = chosen.target
    remove_temporary(folder, below=is_folder)  # of a run that was killed
    with _engine(chosen, not is_folder) as engine:
        if not is_folder:
            process_file(source, target, options, engine)
            return 0
        failed = process_folder(
            inputs, options, chosen.target, chosen.workers, engine, is_total=chosen.total
        )
    return min(failed, 1)


def _check_map(chosen: argparse.Namespace, is_folder: bool, files: tuple[Path, Path]) -> None:
    """Reject a map of several files, and one that would replace another file."""
    if is_folder:
        raise UserError(f"--map is the map of one file, but IN is {chosen.source}.")
    if realpath(chosen.map) in map(realpath, files):
        raise UserError(f"--map must differ from IN and OUT, got {chosen.map}.")


def _options(chosen: argparse.Namespace) -> Options:
    if chosen.readout and chosen.method:
        raise UserError(f"--readout needs --weights: --method {chosen.method} keeps input points.")
    if chosen.workers < 1:
        raise UserError(f"--workers must be at least 1, got {chosen.workers}.")
    if chosen.total and chosen.m is None:
        raise UserError("--total is for --m: a spacing or voxels hold for every file alike.")
    _check_cluster(chosen)
    values: dict[str, Any] = {}
    for field in fields(Options):
        values[field.name] = getattr(chosen, field.name, None)
    if chosen.m is not None:
        values["m"] = parse_size(chosen.m)
    for name in ("spacing", "voxel"):
        if values[name] is not None:
            values[name] = parse_distance(f"--{name}", values[name])
    if chosen.space is not None:
        values["space"] = parse_space(chosen.space)
    if chosen.stratify is not None:
        values["strata"] = Strata.parse(chosen.stratify)
    values["columns"] = columns_of(chosen)
    values["area"] = Area.parse(chosen.bounds, chosen.level, chosen.resolution)
    values["readout"] = chosen.readout or "completed"
    return Options(**values)


def _check_cluster(chosen: argparse.Namespace) -> None:
    if chosen.cluster == "":
        raise UserError("--cluster must be the address of a Dask scheduler, got ''.")
    if chosen.cluster and "://" in chosen.source:
        raise UserError("--cluster: the workers do not see a copy from the web. Download the file.")
    if chosen.cluster and chosen.chunk is None:
        raise UserError("--cluster distributes the chunks of a file: give --chunk as well.")


def _engine(chosen: argparse.Namespace, is_file: bool) -> AbstractContextManager[Engine | None]:
    """Return the engine; None for a folder without ``--cluster``: its files are shared."""
    if chosen.cluster:
        from mops_lightning.files.engine import dask_engine

        return dask_engine(chosen.cluster, progress=is_file)
    engine = None
    if is_file:
        engine = Engine(progress=True)
    return nullcontext(engine)
