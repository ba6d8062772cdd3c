"""Limits in time and memory for reading a file, in processes that may be ended.

A damaged or crafted file can make a parser run for hours or ask for any amount of memory. Where
files are read in processes of their own, the system ends a process that exceeds a limit.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mops_lightning.filesystem import memory

try:
    import resource
except ModuleNotFoundError:  # Windows
    resource = None  # type: ignore[assignment]

SECONDS, BYTES_PER_SECOND = 60.0, 200_000
"""A file may take this long, and longer if it is large."""


class _State:
    on = False


def turn_on() -> None:
    """Apply the limits in this process from now on; the system ends it when one is exceeded."""
    _State.on = resource is not None
    if _State.on:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)


def seconds(path: Path) -> float:
    """Return the time limit of a file."""
    return SECONDS + path.stat().st_size / BYTES_PER_SECOND


@contextmanager
def limited(path: Path) -> Iterator[None]:
    """Read ``path`` within the limits, if they are turned on in this process.

    Raises:
        MemoryError: more memory is needed than the file may take.
    """
    if not _State.on:
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_DATA)
    _set_memory(_data_bytes() + memory(path), before[1])
    # The system's timer also ends a parser that never returns to Python.
    signal.setitimer(signal.ITIMER_REAL, seconds(path))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _set_memory(limit: int, hard: int) -> None:
    if hard == resource.RLIM_INFINITY or limit < hard:
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


def _data_bytes() -> int:
    """Return the memory that counts for RLIMIT_DATA; 0 on systems that do not tell."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmData"))
    except (OSError, StopIteration, ValueError):
        return 0
