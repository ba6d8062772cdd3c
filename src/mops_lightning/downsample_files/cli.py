"""The subcommand ``downsample``."""

import argparse
import sys
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from mops_lightning.downsample_files.settings import METHODS, Settings
from mops_lightning.errors import (
    INTERRUPTED,
    USER_ERROR,
    UserError,
    end,
    one_line,
    quiet_on_closed_pipe,
)
from mops_lightning.filesystem import remove_temporary
from mops_lightning.records.readout_names import GENERATED_READOUTS

DESCRIPTION = """Downsample clouds and meshes from files.

IN is a file (.ply .pcd .las .laz .bin .npy .npz .xyz .txt .off .obj .stl .glb) or a folder of them,
OUT a file (.ply .pcd .las .laz .bin .npy .npz .xyz .txt .obj) or a folder. Clouds are normalised to
the unit sphere, as in training, sampled by a trained sampler (--weights) or an untrained method
(--method), and mapped back. Meshes are first sampled on their surface."""


def main(
    arguments: list[str] | None = None, prog: str = "python -m mops_lightning.downsample_files"
) -> None:
    """Downsample all files; failed files are listed at the end and make the exit status 1.

    Args:
        arguments: those of the command line; None: ``sys.argv``.
        prog: what the user typed to start this command.
    """
    name = prog.removeprefix("python -m ")
    with quiet_on_closed_pipe():
        chosen = make_parser(prog).parse_args(arguments)
        try:
            sys.exit(_run(chosen))
        except UserError as error:
            end(name, str(error), USER_ERROR)
        except BrokenPipeError:
            raise
        except OSError as error:  # of a path that the arguments name
            end(name, one_line(error), USER_ERROR)
        except KeyboardInterrupt:
            end(name, "interrupted. Run the same command to do the rest.", INTERRUPTED)


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
    add("--ratio", type=float, help="with tiles: the share of the points to keep, instead of --m")
    add("--weights", help="a trained sampler: a model's name, a weights.pt or the folder of a run")
    add("--method", choices=METHODS, help="an untrained method, instead of --weights")
    add(
        "--readout",
        choices=GENERATED_READOUTS,
        help="of a trained sampler: the points that it generates, the input points nearest to "
        "them, or these without duplicates, completed to m by farthest point sampling (default)",
    )
    add("--keep-attributes", action="store_true", help="keep colours, normals, intensities, ...")
    add("--surface", type=int, help="points to sample from a mesh first; default: 10000 or 8m")
    add("--format", help="suffix of the files in a folder OUT, such as ply; default: as IN")
    add(
        "--workers",
        type=int,
        default=1,
        help="processes that share a folder's files, or with --cluster local their chunks",
    )
    add(
        "--tile",
        type=int,
        metavar="POINTS",
        help="cut large scenes into tiles of up to so many points (a balanced kd-tree), sample "
        "each as in training, and keep --m points in total",
    )
    add("--tile-size", type=float, metavar="SIDE", help="the same with cubes, in the file's unit")
    add("--chunk", type=int, help="points to read at a time, for clouds larger than memory")
    add(
        "--cluster",
        metavar="ADDRESS",
        help="distribute the chunks of every file over Dask workers: the address of a scheduler, "
        "or 'local' for --workers processes on this machine",
    )
    add("--seed", type=int, default=0, help="seed of random choices")
    add("--overwrite", action="store_true", help="replace existing files")
    return parser


def _run(chosen: argparse.Namespace) -> int:
    """Do what the arguments say and return the exit status."""
    settings = _settings(chosen)
    from mops_lightning.downsample_files.batch import process_file, process_folder
    from mops_lightning.downsample_files.job import sampler_of
    from mops_lightning.downsample_files.outputs import jobs

    sampler_of(settings)  # reports its mistakes before any file is read
    found = jobs(chosen.source, chosen.target, chosen.format, chosen.keep_attributes)
    is_folder = chosen.source.is_dir()
    if not is_folder and found[0][1].exists() and not chosen.overwrite:
        raise UserError(f"{found[0][1]} exists. Give another OUT, or --overwrite.")
    # Of a run that was killed.
    remove_temporary(chosen.target if is_folder else found[0][1].parent, below=is_folder)
    with _engine(chosen) as engine:
        if not is_folder:
            process_file(*found[0], settings, engine)
            return 0
        workers = 1 if chosen.cluster else chosen.workers
        failed = process_folder(found, settings, chosen.target, workers, chosen.overwrite, engine)
        return 1 if failed else 0


def _settings(chosen: argparse.Namespace) -> Settings:
    if chosen.readout and chosen.method:
        raise UserError(f"--readout needs --weights: --method {chosen.method} keeps input points.")
    if chosen.workers < 1:
        raise UserError(f"--workers must be at least 1, got {chosen.workers}.")
    if chosen.cluster == "":
        raise UserError("--cluster must be 'local' or the address of a Dask scheduler, got ''.")
    if chosen.cluster and chosen.chunk is None:
        raise UserError("--cluster distributes the chunks of a file: give --chunk as well.")
    return Settings(
        chosen.m,
        chosen.weights,
        chosen.method,
        chosen.readout or "completed",
        chosen.keep_attributes,
        chosen.surface,
        chosen.seed,
        chosen.chunk,
        chosen.tile,
        chosen.tile_size,
        chosen.ratio,
    )


def _engine(chosen: argparse.Namespace) -> AbstractContextManager[Any]:
    """Return what processes the chunks of a file; see ``large.Engine``."""
    if not chosen.cluster:
        from mops_lightning.downsample_files.large import in_turn

        return nullcontext(in_turn)
    from mops_lightning.downsample_files.cluster import cluster

    return cluster(chosen.cluster, chosen.workers)
