"""Files that are written whole or not at all, what a kill leaves, and unpacking."""

import errno
import os
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from mops_lightning.errors import UserError, one_line

if sys.platform != "win32":
    import fcntl

TEMPORARY = ".mops_lightning-"
"""Prefix of the names of temporary files."""

MEMORY, MEMORY_PER_BYTE = 2 << 30, 200
"""Bytes that the content of a file may take, and more per byte of the file."""


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` when the block ends without an error.

    A reader sees the old file or the new one, never part of one. After an error the old file is
    unchanged and the temporary one is deleted. A killed process leaves the temporary one; see
    ``remove_temporary``.

    Args:
        path: the file to write; its folder is created if necessary.

    Yields:
        The temporary path, in the same folder and with the same suffix.

    Raises:
        OSError: the file cannot be written, or ``path`` is a folder, a pipe or a device.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise OSError(errno.EEXIST, "is a folder, a pipe or a device, not a file", str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    # A part of the name only: with all of a long one the temporary name would be too long.
    prefix = f"{TEMPORARY}{path.stem[:32]}-"
    temporary, handle = _locked_temporary(path.parent, prefix, path.suffix)
    try:
        yield temporary
        # mkstemp makes files that only their owner can read.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        with temporary.open("rb+") as file:  # on disk before it takes the place of the old file
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        # An error of a full disk names no file, others name the temporary one.
        if error.errno and error.filename in (None, str(temporary)):  # numpy gives no number
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)
        if handle is not None:
            os.close(handle)


def _locked_temporary(folder: Path, prefix: str, suffix: str) -> tuple[Path, int | None]:
    """Make a temporary file and lock it, so that ``remove_temporary`` leaves it alone.

    The lock ends with the process.

    Returns:
        The path, and the descriptor that holds the lock; None on systems without such locks.
    """
    while True:
        handle, name = tempfile.mkstemp(dir=folder, prefix=prefix, suffix=suffix)
        if sys.platform == "win32":
            os.close(handle)
            return Path(name), None
        with suppress(OSError):  # some network file systems have no locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        if Path(name).exists():  # nobody removed it before it was locked
            return Path(name), handle
        os.close(handle)


def is_temporary(path: Path) -> bool:
    """Return whether a file is a temporary one of ``atomic_write``, and so not an input."""
    return path.name.startswith(TEMPORARY)


def remove_temporary(folder: Path, below: bool = True) -> None:
    """Remove what killed processes left of ``atomic_write`` in a folder.

    Files that a process is writing are kept, and so are all on systems without locks of files.

    Args:
        folder: it need not exist.
        below: also in all folders below it.
    """
    if sys.platform == "win32":
        return
    pattern = f"{TEMPORARY}*"
    with suppress(OSError):  # the folder cannot be read
        left_behind = folder.rglob(pattern) if below else folder.glob(pattern)
        for path in list(left_behind):
            with suppress(OSError), path.open("rb+") as file:  # in use, gone, or another user's
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()


def memory(path: Path) -> int:
    """Return how many bytes the content of a file may take, unpacked."""
    return MEMORY + MEMORY_PER_BYTE * path.stat().st_size


def load_npz(path: Path) -> dict[str, Any]:
    """Load all arrays of an .npz file, without pickled objects.

    Raises:
        UserError: the file is missing or broken, or announces much more than its length can hold.
    """
    import numpy as np

    try:
        if not path.is_file():  # a pipe may never end
            raise FileNotFoundError("no such file")
        with zipfile.ZipFile(path) as packed:
            announced = sum(info.file_size for info in packed.infolist())
        if announced > memory(path):
            raise ValueError(f"{announced:,} bytes announced in {path.stat().st_size:,}")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        for name, array in arrays.items():
            if not isinstance(array, np.ndarray):  # numpy returns the bytes of other members
                raise ValueError(f"{name} is not an array")
        return arrays
    except Exception as error:  # numpy parses headers as Python literals
        raise UserError(f"{path} is broken: {one_line(error)}.") from None
