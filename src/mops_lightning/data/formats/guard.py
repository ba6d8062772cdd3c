"""Errors of files that hold no usable cloud: each names its file."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.errors import UserError, one_line

LARGEST = 1e150
"""Largest coordinate."""


class BadCloudError(UserError):
    """A file that holds no usable cloud or mesh."""


class WholeOnlyError(BadCloudError):
    """A file that can be read as a whole only, not in ranges of its rows."""


class CannotHoldError(BadCloudError):
    """A format that has no type for the numbers of a table; the message names no file."""


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
        raise BadCloudError(f"{path} is broken, or too large: {one_line(error)}.") from None
    except BaseException as error:  # a panic in lazrs is not an Exception
        raise BadCloudError(f"{path} is broken: {one_line(error)}.") from None


def check_is_file(path: Path) -> None:
    """Reject what is missing, a folder, a pipe or a device."""
    if not path.exists():
        raise BadCloudError(f"{path}: no such file.")
    if not path.is_file():
        raise BadCloudError(f"{path}: not a file.")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Read ``path``; any error names the file.

    Raises:
        BadCloudError: the file is missing or broken, or is a pipe or a device, which may never end.
    """
    check_is_file(path)
    with naming_file(path):
        yield


def ends_early(path: Path, number: int) -> BadCloudError:
    """Return the error of a file that holds fewer points than its header declares."""
    return BadCloudError(f"{path} is broken: it ends after {number} points.")


def check_size(path: Path, number: int, m: int, area: object = None) -> None:
    """Reject a cloud, or an area of it, of fewer points than are to be kept."""
    if number < m:
        where = ""
        if area is not None:
            where = " in the chosen area"
        raise BadCloudError(f"{path} holds {number} points{where}, fewer than --m {m}.")


def check_coordinates(path: Path, points: NDArray[np.float64]) -> None:
    """Reject points ``(n, 3)`` whose squared distances float64 cannot hold."""
    if np.abs(points).max(initial=0.0) > LARGEST:
        raise BadCloudError(f"{path}: its coordinates are too large for float64 distances.")
