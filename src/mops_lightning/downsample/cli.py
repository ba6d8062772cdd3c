"""The command behind ``python -m mops_lightning.downsample``."""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from rich.progress import track

from mops_lightning.errors import INTERRUPTED, USER_ERROR, UserError, end, quiet_on_closed_pipe
from mops_lightning.ops.workers import pool

DESCRIPTION = """Downsample clouds and meshes from files.

IN is a file (.ply .pcd .las .laz .bin .npy .npz .xyz .txt .off .obj .stl .glb) or a folder of such,
OUT a file (.ply .pcd .las .laz .bin .npy .npz .xyz .txt .obj) or a folder. Points are put into the
unit sphere, as in training, sampled by a trained sampler (--weights) or an untrained method
(--method), and mapped back. From meshes, points are sampled on the surface first."""


def main(
    arguments: list[str] | None = None, prog: str = "python -m mops_lightning.downsample"
) -> None:
    """Do all files; a bad one is named at the end and makes the exit status 1.

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
    add("--m", type=int, help="points to keep; default: as many as the weights were trained for")
    add("--weights", type=Path, help="weights.pt of a trained sampler, or the folder of its run")
    add("--method", choices=("fps", "random", "voxel", "poisson"), help="instead of --weights")
    add(
        "--readout",
        choices=("generated", "matched", "completed"),
        help="of a trained sampler: its new points, the input points nearest to them, or these "
        "without doubles, filled up to m by farthest point sampling (the default)",
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
    add("--chunk", type=int, help="read so many points at a time, for clouds larger than memory")
    add(
        "--cluster",
        metavar="ADDRESS",
        help="share the chunks of every file among Dask workers: the address of a scheduler, or "
        "'local' for --workers processes of this machine",
    )
    add("--seed", type=int, default=0, help="of what is random")
    add("--overwrite", action="store_true", help="replace files that are there")
    return parser


def _run(chosen: argparse.Namespace) -> int:
    from mops_lightning.downsample.job import Settings, sampler_of

    if chosen.readout and chosen.method:
        raise UserError(f"--readout is for --weights: --method {chosen.method} keeps input points.")
    if chosen.workers < 1:
        raise UserError(f"--workers must be at least 1, got {chosen.workers}.")
    settings = Settings(
        chosen.m,
        chosen.weights,
        chosen.method,
        chosen.readout or "completed",
        chosen.keep_attributes,
        chosen.surface,
        chosen.seed,
        chosen.chunk,
    )
    if chosen.cluster == "":
        raise UserError("--cluster must be 'local' or the address of a Dask scheduler, got ''.")
    if chosen.cluster and chosen.chunk is None:
        raise UserError("--cluster shares the chunks of a file: give --chunk as well.")
    sampler_of(settings)  # its mistakes come before any file
    jobs = _jobs(chosen)
    if not chosen.source.is_dir() and jobs[0][1].exists() and not chosen.overwrite:
        raise UserError(f"{jobs[0][1]} is there already. Give another OUT, or --overwrite.")
    with _engine(chosen) as engine:
        if chosen.source.is_dir():
            return _folder(jobs, settings, chosen, engine)
        return _file(*jobs[0], settings, engine)


def _file(source: Path, target: Path, settings: Any, engine: Any) -> int:
    from mops_lightning.downsample.files import attempt

    def with_bar(title: str, function: Any, cloud: Any, row_ranges: Any, *common: Any) -> Any:
        results = engine(title, function, cloud, row_ranges, *common)
        total, hidden = len(row_ranges), not sys.stdout.isatty()
        return track(results, title, total=total, disable=hidden, transient=True)

    start = time.perf_counter()
    result = attempt(source, target, settings, None, with_bar)
    if isinstance(result, UserError):
        raise result
    number, whole, dropped = result
    print(f"{target}: {_said(number, whole, dropped)}, {time.perf_counter() - start:.1f} s")
    return 0


def _folder(jobs: list[tuple[Path, Path]], settings: Any, chosen: Any, engine: Any) -> int:
    workers = 1 if chosen.cluster else chosen.workers
    done: Counter[str] = Counter()
    todo = [job for job in jobs if chosen.overwrite or not job[1].exists()]
    failures, dropped = {}, 0
    with _mapped(todo, settings, workers, engine) as results:
        for (source, _), result in track(
            results, "downsampling", total=len(todo), disable=not sys.stdout.isatty()
        ):
            done["failed" if isinstance(result, UserError) else "done"] += 1
            if isinstance(result, UserError):
                failures[source] = result
            else:
                dropped += result[2]
    if len(jobs) > len(todo):
        done["there already"] = len(jobs) - len(todo)
    for source, error in sorted(failures.items()):
        name = "" if str(source) in str(error) else f"{source}: "
        print(f"failed: {name}{error}", file=sys.stderr)
    counts = ", ".join(f"{number} {state}" for state, number in done.items())
    left = f"; {dropped:,} points without finite coordinates left out" if dropped else ""
    print(f"{len(jobs)} files: {counts}{left}; in {chosen.target}")
    return 1 if failures else 0


def _said(number: int, whole: int, dropped: int) -> str:
    left = f" ({dropped:,} more without finite coordinates left out)" if dropped else ""
    return f"{number:,} of {whole:,} points{left}"


def _jobs(chosen: argparse.Namespace) -> list[tuple[Path, Path]]:
    from mops_lightning.downsample.formats.registry import READABLE, WRITERS

    source, target = chosen.source, chosen.target
    wanted = f".{chosen.format.lstrip('.').lower()}" if chosen.format else None
    writable = ", ".join(WRITERS)
    if wanted and wanted not in WRITERS:
        raise UserError(f"--format must be one of {writable}, got {chosen.format}.")
    if not source.exists():
        raise UserError(f"{source}: no such file or folder.")

    def suffix(path: Path) -> str:
        own = path.suffix.lower()
        bare = own == ".obj" and chosen.keep_attributes  # it has no room for them
        return wanted or (own if own in WRITERS and not bare else ".ply")

    if chosen.keep_attributes and ".obj" in (wanted, target.suffix.lower()):
        raise UserError("--keep-attributes: .obj holds coordinates alone. Take .ply, .pcd or .npz.")
    if target.resolve() == source.resolve():
        raise UserError(f"OUT is IN, {source}: give another.")
    if in_the_way := next((p for p in target.parents if p.exists() and not p.is_dir()), None):
        raise UserError(f"OUT lies in {in_the_way}, which is a file and no folder: give another.")
    if not source.is_dir():
        if target.is_dir():
            target = target / f"{source.stem}{suffix(source)}"
        if target.suffix.lower() not in WRITERS:
            raise UserError(f"OUT must end in one of {writable}, got {target}.")
        return [(source, target)]
    if target.is_file():
        raise UserError(f"OUT must be a folder, as IN is one, got the file {target}.")
    files = sorted(p for p in source.rglob("*") if p.is_file() and p.suffix.lower() in READABLE)
    inside = target.resolve()
    files = [p for p in files if inside not in p.resolve().parents]
    if not files:
        raise UserError(f"{source} holds no file that ends in {', '.join(READABLE)}.")
    jobs = [(p, target / p.relative_to(source).with_suffix(suffix(p))) for p in files]
    twice = [path for path, number in Counter(path for _, path in jobs).items() if number > 1]
    if twice:
        both = ", ".join(str(p) for p, goal in jobs if goal == twice[0])
        raise UserError(f"{both} would become {twice[0]}. Rename one, or give another --format.")
    return jobs


def _result(future: Future[Any]) -> Any:
    try:
        return future.result()
    except BrokenProcessPool:
        pool.cache_clear()
        return UserError(
            "a worker process died, perhaps for want of memory, and took this file along: the "
            "same command does the rest; try it with fewer --workers."
        )


def _engine(chosen: argparse.Namespace) -> AbstractContextManager[Any]:
    """Return what works on the chunks of a file; see ``large.Engine``."""
    if not chosen.cluster:
        from mops_lightning.downsample.large import in_turn

        return nullcontext(in_turn)
    from mops_lightning.downsample.cluster import cluster

    return cluster(chosen.cluster, chosen.workers)


@contextmanager
def _mapped(
    jobs: list[tuple[Path, Path]], settings: Any, workers: int, engine: Any
) -> Iterator[Iterator[Any]]:
    """Give pairs of job and result, in the order in which they come."""
    from mops_lightning.downsample.files import attempt

    if workers == 1 or len(jobs) < 2:
        yield ((job, attempt(*job, settings, None, engine)) for job in jobs)
        return
    workers = min(workers, len(jobs))
    futures = {pool(workers).submit(attempt, *job, settings, workers): job for job in jobs}
    try:
        yield ((futures[future], _result(future)) for future in as_completed(futures))
    finally:
        for future in futures:
            future.cancel()
