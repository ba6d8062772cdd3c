"""Downsampling one file or a folder of files, with progress and a closing line.

Worker processes import this module, so it imports torch only when there is a file to process.
"""

import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Generator
from contextlib import closing
from pathlib import Path
from typing import Any

from rich.progress import track

from mops_lightning.data.formats import limits
from mops_lightning.downsample_files.outputs import check_writable
from mops_lightning.downsample_files.processes import Died, processes
from mops_lightning.downsample_files.settings import Settings
from mops_lightning.errors import UserError, one_line, printable


def attempt(
    source: Path, target: Path, settings: Settings, workers: int | None, engine: Any = None
) -> Any:
    """Downsample one file and return the result of ``job.run``, or the error.

    Args:
        source: the file.
        target: the file to write.
        settings: what to do.
        workers: number of processes that share the cores; None: leave torch's threads alone.
        engine: processes the chunks of a file, see ``large.Engine``; None: this process.
    """
    from mops_lightning.downsample_files.job import run
    from mops_lightning.downsample_files.large import in_turn

    if workers:
        import torch

        torch.set_num_threads(max((os.cpu_count() or 1) // workers, 1))
    try:
        return run(source, target, settings, engine or in_turn)
    except UserError as error:
        return error
    except Exception as error:
        return UserError(f"{source}: {one_line(error)}.")


def process_file(source: Path, target: Path, settings: Settings, engine: Any) -> None:
    """Downsample one file and print what was written.

    Raises:
        UserError: it failed.
    """

    def with_progress(title: str, function: Any, cloud: Any, row_ranges: Any, *common: Any) -> Any:
        results = engine(title, function, cloud, row_ranges, *common)
        total, hidden = len(row_ranges), not sys.stdout.isatty()
        return track(results, title, total=total, disable=hidden, transient=True)

    start = time.perf_counter()
    result = attempt(source, target, settings, None, with_progress)
    if isinstance(result, UserError):
        raise result
    written, number, dropped, seams = result
    more = f" ({dropped:,} more without finite coordinates left out)" if dropped else ""
    seconds = time.perf_counter() - start
    close = ""
    if seams is not None:
        close = f", {seams.after:,} of {seams.before:,} close pairs at seams left"
    print(printable(f"{target}: {written:,} of {number:,} points{more}{close}, {seconds:.1f} s"))


def process_folder(
    jobs: list[tuple[Path, Path]],
    settings: Settings,
    target: Path,
    workers: int,
    overwrite: bool,
    engine: Any,
) -> int:
    """Downsample files, print errors and a closing line, and return how many files failed.

    Args:
        jobs: input and output files.
        settings: what to do.
        target: the folder of the output files, for the closing line.
        workers: number of processes that share the files.
        overwrite: replace existing output files; otherwise they are skipped.
        engine: see ``large.Engine``.
    """
    done: Counter[str] = Counter()
    todo = [job for job in jobs if overwrite or not job[1].exists()]
    failures, dropped = {}, 0
    if todo:
        check_writable(target)
    results = _results(todo, settings, workers, engine)
    with closing(results):  # ends the processes when the user interrupts
        for (source, _), result in track(
            results, "downsampling", total=len(todo), disable=not sys.stdout.isatty()
        ):
            done["failed" if isinstance(result, UserError) else "done"] += 1
            if isinstance(result, UserError):
                failures[source] = result
            else:
                dropped += result[2]
    if len(jobs) > len(todo):
        done["skipped"] = len(jobs) - len(todo)
    for source, error in sorted(failures.items()):
        name = "" if str(source) in str(error) else f"{source}: "
        print(printable(f"failed: {name}{error}"), file=sys.stderr)
    counts = ", ".join(f"{number} {state}" for state, number in done.items())
    left = f"; {dropped:,} points without finite coordinates left out" if dropped else ""
    print(printable(f"{len(jobs)} files: {counts}{left}; in {target}"))
    return len(failures)


def _results(
    jobs: list[tuple[Path, Path]], settings: Settings, workers: int, engine: Any
) -> Generator[Any, None, None]:
    """Yield pairs of job and result, in the order of completion.

    Several files are read in other processes, so that one bad file cannot stop the rest; with
    ``--cluster`` the cluster's processes read them.
    """
    from mops_lightning.downsample_files.large import in_turn

    if engine is not in_turn or len(jobs) < 2:
        yield from ((job, attempt(*job, settings, None, engine)) for job in jobs)
        return
    shared = workers if workers > 1 else None
    calls = ((*job, settings, shared) for job in jobs)
    for place, result in processes(min(workers, len(jobs))).run(attempt, calls):
        yield jobs[place], _death(jobs[place][0], result) if isinstance(result, Died) else result


def _death(source: Path, died: Died) -> UserError:
    """Return the error of a file whose process died."""
    if died.signal == getattr(signal, "SIGALRM", -1):
        return UserError(
            f"{source} is broken or very slow to read: it took more than "
            f"{limits.seconds(source):.0f} s. Downsample it alone, without a limit."
        )
    how = f" (signal {died.signal})" if died.signal else ""
    return UserError(
        f"{source} is broken or needs too much memory: its process died{how}. Downsample it alone, "
        "or run the same command again with fewer --workers."
    )
