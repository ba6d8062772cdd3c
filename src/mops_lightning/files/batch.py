"""Downsampling one file or a folder of files: their outputs, progress and a closing line.

Worker processes import this module, so it imports torch only when there is a file to process.
"""

import os
import sys
import time
from collections import defaultdict
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from multiprocessing import active_children, get_context
from os.path import realpath  # unlike Path.resolve, it accepts loops of symbolic links
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rich.progress import track

from mops_lightning.data.formats.registry import READABLE, WRITERS
from mops_lightning.errors import UserError, as_line, one_line, printable
from mops_lightning.files.arguments import counted
from mops_lightning.files.engine import Engine
from mops_lightning.files.options import Options
from mops_lightning.files.total import Job, share_total
from mops_lightning.filesystem import is_temporary
from mops_lightning.ops.workers import start_worker

if TYPE_CHECKING:
    from mops_lightning.files.chunks import Outcome

NO_E57 = (
    "E57 is not written: pye57 stores coordinates in single precision. Write .las, .ply or .npz."
)

FilePair = tuple[Path, Path]
"""An input file and its output file."""


class Inputs(NamedTuple):
    """The files of a command.

    Attributes:
        pairs: input and output files.
        unreadable: files of a folder of other kinds.
    """

    pairs: list[FilePair]
    unreadable: list[Path]


def find_inputs(source: Path, target: Path) -> Inputs:
    """Return the input files and their output files.

    An output file in a folder has the format of its input, or .ply where that cannot be written.

    Args:
        source: a file, a folder, or a pattern of files, such as ``county/*.laz``.
        target: a file or a folder; a folder if ``source`` is no file.

    Raises:
        UserError: an input is missing, or an output is ambiguous or cannot be written.
    """
    if not source.exists() and not is_many(source):
        raise UserError(f"{source}: no such file or folder.")
    if realpath(target) == realpath(source):
        raise UserError(f"OUT must differ from IN, got {source} for both.")
    for parent in target.parents:
        if parent.exists() and not parent.is_dir():
            raise UserError(f"OUT: {parent} is a file, not a folder. Give another OUT.")
    if is_many(source):
        return _several(source, target)
    if target.is_dir():
        target = _output(source, target / source.name)
    suffix = target.suffix.lower()
    if suffix == ".e57":
        raise UserError(f"{target}: {NO_E57}")
    if suffix not in WRITERS:
        endings = ", ".join(WRITERS)
        raise UserError(f"OUT must end in one of {endings}, got {target}.")
    return Inputs([(source, target)], [])


def _several(source: Path, target: Path) -> Inputs:
    """Return the files of a folder or a pattern."""
    if source.is_dir():
        base = source
        pattern = "**/*"
    else:
        base = source.parent
        pattern = source.name
    files = _files(base, pattern, target)
    readable = [path for path in files if _is_readable(path)]
    if not readable:
        endings = ", ".join(READABLE)
        raise UserError(f"{base / pattern}: no file ends in {endings}.")
    pairs = []
    for path in readable:
        beside = target / path.relative_to(base)
        pairs.append((path, _output(path, beside)))
    _check_different(pairs)
    unreadable = [path for path in files if not _is_readable(path)]
    return Inputs(pairs, unreadable)


def _is_readable(path: Path) -> bool:
    return path.suffix.lower() in READABLE


def _check_different(pairs: list[FilePair]) -> None:
    """Check that no two files have the same output."""
    sources: dict[Path, list[str]] = defaultdict(list)
    for source, target in pairs:
        sources[target].append(str(source))
    for target, same in sources.items():
        if len(same) > 1:
            both = " and ".join(same)
            raise UserError(f"{both} have the same output {target}. Rename one.")


def is_many(source: Path) -> bool:
    """Return whether a path is a folder, or a pattern such as ``county/*.laz``."""
    has_wildcards = not set("*?[").isdisjoint(source.name)
    return source.is_dir() or (has_wildcards and not source.exists())


def _output(source: Path, path: Path) -> Path:
    """Return ``path`` with the suffix of ``source``, or .ply where that cannot be written."""
    own = source.suffix.lower()
    if own not in WRITERS:
        own = ".ply"
    return path.with_suffix(own)


def _files(folder: Path, pattern: str, target: Path) -> list[Path]:
    """Return the files of a pattern below a folder, without hidden ones and those below target."""
    if target.is_file():
        raise UserError(f"OUT must be a folder because IN is several, got the file {target}.")
    outputs = Path(realpath(target))
    files = []
    for path in folder.glob(pattern):
        is_file = path.is_file() and not is_temporary(path)
        is_shown = not path.name.startswith(".") or _is_readable(path)
        if is_file and is_shown and outputs not in Path(realpath(path)).parents:
            files.append(path)
    return sorted(files)


def attempt(
    source: Path,
    target: Path,
    options: Options,
    workers: int | None = None,
    engine: Engine | None = None,
) -> "Outcome | UserError":
    """Downsample one file and return the numbers of its points, or the error.

    Args:
        source: the file.
        target: the file to write.
        options: how.
        workers: number of processes that share the cores; None: leave torch's threads alone.
        engine: processes the chunks of a file; None: this process.
    """
    from mops_lightning.files.downsample import downsample_file

    if workers:
        import torch

        cores = os.cpu_count() or 1
        torch.set_num_threads(max(cores // workers, 1))
    try:
        return downsample_file(source, target, options, engine)
    except UserError as error:
        return error
    except Exception as error:
        return UserError(f"{source}: {one_line(error)}.")


def process_file(source: Path, target: Path, options: Options, engine: Engine | None) -> None:
    """Downsample one file and print the numbers of its points.

    Raises:
        UserError: it failed.
    """
    start = time.perf_counter()
    result = attempt(source, target, options, engine=engine)
    if isinstance(result, UserError):
        raise result
    seconds = time.perf_counter() - start
    words = _told(result, options)
    print(printable(f"{target}: {words}, {seconds:.1f} s"))


def _told(result: "Outcome", options: Options) -> str:
    """Return the numbers of points of a file, and how they were chosen, in words."""
    points = counted(result.number, "point")
    words = f"{result.kept:,} of {points}"
    if result.dropped:
        words += f" ({result.dropped:,} more without finite coordinates left out)"
    if result.drawn is not None and result.drawn < result.number:
        words += f", chosen among {result.drawn:,} that were drawn at random (--chunk)"
    if options.voxel is not None:
        words += f", voxels of {options.voxel:g} from the origin 0 0 0"
    return words


def process_folder(
    inputs: Inputs,
    options: Options,
    target: Path,
    workers: int,
    engine: Engine | None,
    is_total: bool = False,
) -> int:
    """Downsample files, print errors and a closing line, and return how many files failed.

    Args:
        inputs: input and output files. Existing output files are skipped, unless
            ``options.overwrite``.
        options: how.
        target: the folder of the output files, for the closing line.
        workers: number of processes that share the files.
        engine: processes the chunks of one file after the other; None: processes share the files.
        is_total: share ``options.m`` among all files, in proportion to their points.
    """
    jobs = [Job(source, output, options) for source, output in inputs.pairs]
    number = len(jobs) + len(inputs.unreadable)
    failures: dict[Path, UserError] = {}
    if is_total:
        jobs, failures = share_total(jobs)
    todo = jobs
    if not options.overwrite:
        todo = [job for job in jobs if not job.target.exists()]
    if todo:
        target.mkdir(parents=True, exist_ok=True)
        if not os.access(target, os.W_OK):
            raise UserError(f"OUT: cannot write into {target}. Give another OUT.")
    done = 0
    dropped = 0
    results = _results(todo, workers, engine)
    is_quiet = not sys.stdout.isatty()
    with closing(results):  # ends the processes when the user interrupts
        for job, result in track(results, "downsampling", total=len(todo), disable=is_quiet):
            if isinstance(result, UserError):
                failures[job.source] = result
            else:
                done += 1
                dropped += result.dropped
    _tell_failures(failures)
    counts = {
        "failed": len(failures),
        "done": done,
        "done before": len(jobs) - len(todo),
        "skipped": len(inputs.unreadable),
    }
    states = [f"{count} {state}" for state, count in counts.items() if count]
    words = ", ".join(states)
    if inputs.unreadable:
        kinds = " ".join(_kinds(inputs.unreadable))
        words += f": {kinds}"
    if dropped:
        words += f"; {counted(dropped, 'point')} without finite coordinates left out"
    files = counted(number, "file")
    print(printable(f"{files}: {words}; in {target}"))
    return len(failures)


def _tell_failures(failures: dict[Path, UserError]) -> None:
    for source, error in sorted(failures.items()):
        text = str(error)
        if str(source) not in text:
            text = f"{source}: {text}"
        print(as_line(f"failed: {text}"), file=sys.stderr)


def _kinds(paths: list[Path]) -> list[str]:
    """Return the suffixes of files, or their names where they have none."""
    kinds = {path.suffix.lower() or path.name for path in paths}
    return sorted(kinds)


def _results(
    jobs: list[Job], workers: int, engine: Engine | None
) -> Generator["tuple[Job, Outcome | UserError]", None, None]:
    """Yield jobs and results, in the order of completion."""
    workers = min(workers, len(jobs))
    if engine is not None or workers < 2:
        for job in jobs:
            yield job, attempt(*job, engine=engine)
        return
    # Spawned, because forking after torch has started threads can deadlock.
    with ProcessPoolExecutor(workers, get_context("spawn"), start_worker) as executor:
        job_of = {}
        for job in jobs:
            future = executor.submit(attempt, *job, workers)
            job_of[future] = job
        try:
            for future in as_completed(job_of):
                job = job_of[future]
                try:
                    yield job, future.result()
                except BrokenProcessPool:
                    died = "its process died, perhaps for lack of memory"
                    again = "Run the same command again with fewer --workers."
                    yield job, UserError(f"{job.source}: {died}. {again}")
        except BaseException:  # interrupted
            for process in active_children():
                process.terminate()
            raise
