"""Parsers in a separate process, with limits in time and memory.

laspy and trimesh trust the counts and offsets of a file: a damaged or crafted file can make them
run for hours, allocate any amount of memory, or end their process. Here only the separate one ends.
"""

import atexit
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from typing import Any, TypeVar

from mops_lightning.data.formats.guard import BadCloudError, naming_file
from mops_lightning.errors import UserError
from mops_lightning.filesystem import memory

try:
    import resource
except ModuleNotFoundError:  # Windows, which has no limits
    resource = None  # type: ignore[assignment]

Result = TypeVar("Result")

SECONDS, BYTES_PER_SECOND = 30.0, 200_000
"""A file may take this long, and longer if it is large."""

COMPILING = 120.0
"""Seconds more for a parser that compiles its code: numba took 18 to 27 on one busy core."""

COMMAND = (
    "import sys; sys.path[:] = {}; from mops_lightning.data.formats import isolated as i; i.serve()"
)

_idle: list[Popen[bytes]] = []
"""Processes that wait for their next call."""

if hasattr(os, "register_at_fork"):
    # Two processes that write to one reader would get each other's results.
    os.register_at_fork(after_in_child=_idle.clear)


def isolated(
    function: Callable[..., Result], path: Path, *arguments: Any, compiles: bool = False
) -> Result:
    """Return ``function(path, *arguments)``, called in another process.

    Args:
        function: of a module that does not import torch, so that the process starts fast.
        path: the file that it parses.
        arguments: can be pickled, as can the result.
        compiles: whether the parser compiles its code at the first call and gets more time for it.

    Raises:
        UserError: the function raised an error, or its process exceeded a limit or died.
    """
    seconds = SECONDS + path.stat().st_size / BYTES_PER_SECOND
    if compiles:
        seconds += COMPILING
    try:
        process = _idle.pop()
    except IndexError:
        process = _start()
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        call = function, path, arguments, seconds, memory(path), Path.cwd()
        pickle.dump(call, process.stdin)
        process.stdin.flush()
        result: Result | UserError = pickle.load(process.stdout)
    except (EOFError, OSError, pickle.UnpicklingError):
        process.wait()
        _end(process)
        if process.returncode == -getattr(signal, "SIGALRM", 0):
            raise BadCloudError(
                f"{path} is broken: reading it took more than {seconds:.0f} s."
            ) from None
        raise BadCloudError(
            f"{path} is broken, or too large for the memory: the process that read it died."
        ) from None
    except BaseException:  # interrupted; a later call must not get this result
        _end(process)
        raise
    _idle.append(process)
    if isinstance(result, UserError):
        raise result
    return result


def _start() -> Popen[bytes]:
    # Not multiprocessing, which would import the user's script again.
    command = [sys.executable, "-c", COMMAND.format(sys.path)]
    # What a dying parser prints is of no use.
    return Popen(command, stdin=PIPE, stdout=PIPE, stderr=DEVNULL)


def _end(process: Popen[bytes]) -> None:
    process.kill()
    with suppress(OSError), process:  # closes its pipes, also with half of a call in one
        pass


@atexit.register
def _end_all() -> None:
    while _idle:
        _end(_idle.pop())


def serve() -> None:
    """Answer the calls of ``isolated`` until the caller's process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the caller
    if resource is not None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    results = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a parser prints is no result
    while True:
        try:
            function, path, arguments, seconds, data, folder = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            with naming_file(path), _limited(seconds, data):
                os.chdir(folder)
                result = function(path, *arguments)
        except UserError as error:
            result = error
        pickle.dump(result, results)
        results.flush()
        del result


@contextmanager
def _limited(seconds: float, data: int) -> Iterator[None]:
    """Let the system end this process after so many seconds, and refuse it more bytes of data."""
    if resource is not None:
        most = resource.getrlimit(resource.RLIMIT_DATA)[1]
        soft = data if most == resource.RLIM_INFINITY else min(data, most)
        resource.setrlimit(resource.RLIMIT_DATA, (soft, most))
        # The system's timer also ends a parser that never returns to Python.
        signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        if resource is not None:
            signal.setitimer(signal.ITIMER_REAL, 0)
            resource.setrlimit(resource.RLIMIT_DATA, (most, most))
