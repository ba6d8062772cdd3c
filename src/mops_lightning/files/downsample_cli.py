"""The subcommand ``downsample``."""

import argparse
import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from os.path import realpath
from pathlib import Path

from mops_lightning.errors import UserError, one_line_endings
from mops_lightning.files.engine import Engine, LocalEngine
from mops_lightning.files.options import Options
from mops_lightning.filesystem import remove_temporary
from mops_lightning.records.readout_names import GENERATED_READOUTS
from mops_lightning.zoo.names import UNTRAINED

DESCRIPTION = """Downsample clouds and meshes from files.

IN is a file (.ply .pcd .las .laz .bin .npy .npz .xyz .txt .off .obj .stl .glb) or a folder of them,
OUT a file (.ply .pcd .las .laz .bin .npy .npz .xyz .txt) or a folder. Clouds are normalised to
the unit sphere, as in training, sampled by a trained sampler (--weights) or an untrained method
(--method), and mapped back. Meshes are first sampled on their surface."""


def main(arguments: list[str] | None = None, prog: str = "mops-lightning downsample") -> None:
    """Downsample all files; failed files are listed at the end and make the exit status 1.

    Args:
        arguments: of the command line; None: ``sys.argv``.
        prog: what the user typed to start this command.
    """
    with one_line_endings(prog, "interrupted. Run the same command to do the rest."):
        sys.exit(_run(make_parser(prog).parse_args(arguments)))


def make_parser(prog: str) -> argparse.ArgumentParser:
    """Return the parser of this command's arguments."""
    parser = argparse.ArgumentParser(
        prog=prog,
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("source", metavar="IN", type=Path, help="a file or a folder")
    add("target", metavar="OUT", type=Path, help="a file or a folder")
    add("--m", type=int, help="number of points to keep; default: as the weights were trained for")
    add(
        "--weights", help="a trained sampler: a model's name, a weights file or the folder of a run"
    )
    add("--method", choices=UNTRAINED, help="an untrained method, instead of --weights")
    add(
        "--readout",
        choices=GENERATED_READOUTS,
        help="of a trained sampler: the points that it generates, the input points nearest to "
        "them, or these without duplicates, completed to m by farthest point sampling (default)",
    )
    add("--keep-attributes", action="store_true", help="keep colours, normals, intensities, ...")
    add("--surface", type=int, help="points to sample from a mesh first; default: 10000 or 8m")
    add(
        "--workers",
        type=int,
        default=1,
        help="processes that share a folder's files",
    )
    add(
        "--tile",
        type=int,
        metavar="POINTS",
        help="cut large scenes into tiles of up to so many points (a balanced kd-tree), sample "
        "each as in training, and keep --m points in total",
    )
    add("--chunk", type=int, help="points to read at a time, for clouds larger than memory")
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
    add("--seed", type=int, default=0, help="seed of random choices")
    add("--overwrite", action="store_true", help="replace existing files")
    return parser


def _run(chosen: argparse.Namespace) -> int:
    """Do what the arguments say and return the exit status."""
    options = _options(chosen)
    from mops_lightning.files.batch import process_file, process_folder
    from mops_lightning.files.downsample import load_sampler
    from mops_lightning.files.paths import file_pairs

    load_sampler(options)  # reports its mistakes before any file is read
    if chosen.cluster:  # workers may have a different working directory
        chosen.source = chosen.source.absolute()
    pairs = file_pairs(chosen.source, chosen.target)
    is_folder = chosen.source.is_dir()
    if not is_folder and pairs[0][1].exists() and not chosen.overwrite:
        raise UserError(f"{pairs[0][1]} exists. Give another OUT, or --overwrite.")
    if chosen.map is not None:
        _check_map(chosen, is_folder, pairs[0])
    # Of a run that was killed.
    remove_temporary(chosen.target if is_folder else pairs[0][1].parent, below=is_folder)
    with _engine(chosen) as engine:
        if not is_folder:
            process_file(*pairs[0], options, engine)
            return 0
        workers, overwrite = chosen.workers, chosen.overwrite
        failed = process_folder(pairs, options, chosen.target, workers, overwrite, engine)
        return 1 if failed else 0


def _check_map(chosen: argparse.Namespace, is_folder: bool, files: tuple[Path, Path]) -> None:
    """Reject a map of several files, and one that would replace another file."""
    if is_folder:
        raise UserError(f"--map is the map of one file, but IN is the folder {chosen.source}.")
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
    if chosen.cluster and chosen.chunk is None:
        raise UserError("--cluster distributes the chunks of a file: give --chunk as well.")
    values = {field.name: getattr(chosen, field.name) for field in fields(Options)}
    return Options(**{**values, "readout": chosen.readout or "completed"})


def _engine(chosen: argparse.Namespace) -> AbstractContextManager[Engine | None]:
    """Return the engine; None for a folder without ``--cluster``: its files are shared."""
    is_file = not chosen.source.is_dir()
    if not chosen.cluster:
        return nullcontext(LocalEngine(progress=True) if is_file else None)
    from mops_lightning.files.engine import dask_engine

    return dask_engine(chosen.cluster, progress=is_file)
