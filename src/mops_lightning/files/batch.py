"""Downsampling one file or a folder of files: their outputs, progress and a closing line.

Worker processes import this module, so it imports torch only when there is a file to process.
"""

import os
import sys
import time
from collections import Counter
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from multiprocessing import active_children, get_context
from os.path import realpath  # unlike Path.resolve, it accepts loops of symbolic links
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import track

from mops_lightning.data.formats.registry import READABLE, WRITERS
from mops_lightning.errors import UserError, as_line, one_line, printable
from mops_lightning.files.engine import Engine
from mops_lightning.files.options import Options
from mops_lightning.filesystem import is_temporary
from mops_lightning.ops.workers import start_worker

if TYPE_CHECKING:
    from mops_lightning.files.chunks import Outcome

NO_E57 = (
    "E57 is not written: pye57 stores coordinates in single precision. Write .las, .ply or .npz."
)

FilePair = tuple[Path, Path]
"""An input file and its output file."""


def file_pairs(source: Path, target: Path) -> list[FilePair]:
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
    if blocking := next((p for p in target.parents if p.exists() and not p.is_dir()), None):
        raise UserError(f"OUT: {blocking} is a file, not a folder. Give another OUT.")
    if is_many(source):
        base, pattern = (source, "**/*") if source.is_dir() else (source.parent, source.name)
        inputs = _inputs(base, pattern, target)
        pairs = [(path, _output(path, target / path.relative_to(base))) for path in inputs]
        targets = Counter(path for _, path in pairs)
        if twice := next((path for path, number in targets.items() if number > 1), None):
            both = " and ".join(str(path) for path, output in pairs if output == twice)
            raise UserError(f"{both} have the same output {twice}. Rename one.")
        return pairs
    if target.is_dir():
        target = _output(source, target / source.name)
    if target.suffix.lower() == ".e57":
        raise UserError(f"{target}: {NO_E57}")
    if target.suffix.lower() not in WRITERS:
        raise UserError(f"OUT must end in one of {', '.join(WRITERS)}, got {target}.")
    return [(source, target)]


def is_many(source: Path) -> bool:
    """Return whether a path is a folder, or a pattern such as ``county/*.laz``."""
    return source.is_dir() or not (source.exists() or set("*?[").isdisjoint(source.name))


def _output(source: Path, path: Path) -> Path:
    """Return ``path`` with the suffix of ``source``, or .ply where that cannot be written."""
    own = source.suffix.lower()
    return path.with_suffix(own if own in WRITERS else ".ply")


def _inputs(folder: Path, pattern: str, target: Path) -> list[Path]:
    """Return the readable files of a pattern below a folder, without those below ``target``."""
    if target.is_file():
        raise UserError(f"OUT must be a folder because IN is several, got the file {target}.")
    outputs = Path(realpath(target))
    files = sorted(
        path
        for path in folder.glob(pattern)
        if path.suffix.lower() in READABLE and path.is_file() and not is_temporary(path)
        if outputs not in Path(realpath(path)).parents
    )
    if not files:
        raise UserError(f"{folder / pattern}: no file ends in {', '.join(READABLE)}.")
    return files


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

        torch.set_num_threads(max((os.cpu_count() or 1) // workers, 1))
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
    more = f" ({result.dropped:,} more without finite coordinates left out)"
    print(
        printable(
            f"{target}: {result.kept:,} of {result.number:,} points"
            f"{more if result.dropped else ''}, {time.perf_counter() - start:.1f} s"
        )
    )


def process_folder(
    pairs: list[FilePair],
    options: Options,
    target: Path,
    workers: int,
    overwrite: bool,
    engine: Engine | None,
) -> int:
    """Downsample files, print errors and a closing line, and return how many files failed.

    Args:
        pairs: input and output files.
        options: how.
        target: the folder of the output files, for the closing line.
        workers: number of processes that share the files.
        overwrite: replace existing output files; otherwise they are skipped.
        engine: processes the chunks of one file after the other; None: processes share the files.
    """
    done: Counter[str] = Counter()
    todo = [pair for pair in pairs if overwrite or not pair[1].exists()]
    failures, dropped = {}, 0
    if todo:
        target.mkdir(parents=True, exist_ok=True)
        if not os.access(target, os.W_OK):
            raise UserError(f"OUT: cannot write into {target}. Give another OUT.")
    results = _results(todo, options, workers, engine)
    with closing(results):  # ends the processes when the user interrupts
        for (source, _), result in track(
            results, "downsampling", total=len(todo), disable=not sys.stdout.isatty()
        ):
            done["failed" if isinstance(result, UserError) else "done"] += 1
            if isinstance(result, UserError):
                failures[source] = result
            else:
                dropped += result.dropped
    if len(pairs) > len(todo):
        done["skipped"] = len(pairs) - len(todo)
    for source, error in sorted(failures.items()):
        name = "" if str(source) in str(error) else f"{source}: "
        print(as_line(f"failed: {name}{error}"), file=sys.stderr)
    counts = ", ".join(f"{number} {state}" for state, number in done.items())
    left = f"; {dropped:,} points without finite coordinates left out" if dropped else ""
    print(printable(f"{len(pairs)} files: {counts}{left}; in {target}"))
    return len(failures)


def _results(
    pairs: list[FilePair], options: Options, workers: int, engine: Engine | None
) -> Generator["tuple[FilePair, Outcome | UserError]", None, None]:
    """Yield pairs of files and results, in the order of completion."""
    workers = min(workers, len(pairs))
    if engine is not None or workers < 2:
        yield from ((pair, attempt(*pair, options, engine=engine)) for pair in pairs)
        return
    # Spawned, because forking after torch has started threads can deadlock.
    with ProcessPoolExecutor(workers, get_context("spawn"), start_worker) as executor:
        pair_of = {executor.submit(attempt, *pair, options, workers): pair for pair in pairs}
        try:
            for future in as_completed(pair_of):
                pair = pair_of[future]
                try:
                    yield pair, future.result()
                except BrokenProcessPool:
                    died = "its process died, perhaps for lack of memory"
                    again = "Run the same command again with fewer --workers."
                    yield pair, UserError(f"{pair[0]}: {died}. {again}")
        except BaseException:  # interrupted
            for process in active_children():
                process.terminate()
            raise
