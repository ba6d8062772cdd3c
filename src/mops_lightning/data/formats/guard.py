"""Reading damaged files: errors that name the file, and limits in time and memory.

A damaged or crafted file can make a parser run for hours or allocate any amount of memory. Where
files are read in separate processes, the system ends a process that exceeds a limit.
"""

import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.errors import UserError, one_line
from mops_lightning.filesystem import memory

try:
    import resource
except ModuleNotFoundError:  # Windows
    resource = None  # type: ignore[assignment]

SECONDS, BYTES_PER_SECOND = 60.0, 200_000
"""A file may take this long, and longer if it is large."""

LARGEST = 1e150
"""Largest coordinate."""


class BadCloudError(UserError):
    """A file that holds no usable cloud or mesh."""


class _State:
    limits_are_on = False


def turn_on_limits() -> None:
    """Apply the limits in this process from now on; the system ends it when one is exceeded."""
    _State.limits_are_on = resource is not None
    if _State.limits_are_on:
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
    if not _State.limits_are_on:
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_DATA)
    most = _data_bytes() + memory(path)
    if before[1] == resource.RLIM_INFINITY or most < before[1]:
        resource.setrlimit(resource.RLIMIT_DATA, (most, before[1]))
    # The system's timer also ends a parser that never returns to Python.
    signal.setitimer(signal.ITIMER_REAL, seconds(path))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _data_bytes() -> int:
    """Return the memory that counts for RLIMIT_DATA; 0 on systems that do not tell."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmData"))
    except (OSError, StopIteration, ValueError):
        return 0


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Turn any error of a parser into one that names the file.

    Raises:
        BadCloudError: in place of every error except ``UserError``.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the error says what is wrong
            yield
    except (UserError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except MemoryError as error:
        raise BadCloudError(
            f"{path} is broken or too large for the memory: {one_line(error)}."
        ) from None
    except BaseException as error:  # a panic in lazrs is not an Exception
        raise BadCloudError(f"{path} is broken: {one_line(error)}.") from None


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Read ``path`` within the limits; any error names the file.

    Raises:
        BadCloudError: the file is missing or broken.
    """
    if not path.is_file():
        raise BadCloudError(f"{path}: no such file.")
    with limited(path), naming_file(path):
        yield


def ends_early(path: Path, number: int) -> BadCloudError:
    """Return the error of a file that holds fewer points than its header declares."""
    return BadCloudError(f"{path} is broken: it ends after {number} points.")


def check_size(path: Path, number: int, m: int) -> None:
    """Reject a cloud of fewer points than are to be kept."""
    if number < m:
        raise BadCloudError(f"{path} holds {number} points, fewer than --m {m}.")


def check_coordinates(path: Path, points: NDArray[np.float64]) -> None:
    """Reject points ``(n, 3)`` whose squared distances float64 cannot hold."""
    if np.abs(points).max(initial=0.0) > LARGEST:
        raise BadCloudError(f"{path}: its coordinates are too large for float64 distances.")
