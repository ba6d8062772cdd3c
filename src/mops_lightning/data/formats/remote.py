"""COPC files at a web address: a copy on disk with the bytes of an area, and holes elsewhere."""

from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from mops_lightning.data.formats import las
from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.guard import naming_file
from mops_lightning.data.formats.isolated import isolated
from mops_lightning.data.formats.las.header import COPC
from mops_lightning.errors import UserError, one_line

HEAD = 2**16
BLOCK = 2**20
"""Bytes that are read first, and most bytes in memory."""

PATIENCE = 60
"""Seconds without an answer."""


@contextmanager
def local(source: str, area: Area | None) -> Iterator[Path]:
    """Yield the path of a file; of one at a web address, that of a copy.

    The copy has the header, the octree, and the cells that overlap the area, at their places; all
    else is a hole, which takes no room on most disks. It is deleted afterwards.

    Args:
        source: a path, or the address of a COPC file, which begins with ``http://`` or ``https://``.
        area: the part of the file to read.

    Raises:
        UserError: the file is not read by areas, or its server does not send parts of files.
    """
    if not source.startswith(("http://", "https://")):
        yield Path(source)
        return
    address = source.partition("?")[0]
    name = address.rpartition("/")[2]
    if not name.lower().endswith(".laz"):
        raise UserError(f"{source} must be a .copc.laz file: download others, and give their path.")
    if area is None:
        raise UserError(f"{source}: give --bounds, --level or --resolution, or download all of it.")
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        try:
            with naming_file(path):
                _copy(source, area, path)
            yield path
        except UserError as error:
            message = str(error).replace(str(path), source)
            raise type(error)(message) from None


def _copy(address: str, area: Area, path: Path) -> None:
    with path.open("wb+") as file:
        size = _fetch(address, file, 0, HEAD)
        file.seek(0)
        head = file.read(HEAD)
        if head[377:381] != COPC.encode():
            raise UserError(f"{path} is not a COPC file: download it, and give its path.")
        first = int.from_bytes(head[96:100], "little")
        if first + 8 > HEAD:
            _fetch(address, file, HEAD, first + 8)
        file.seek(first)
        table = int.from_bytes(file.read(8), "little")  # the octree follows it
        if not first < table < size:
            raise UserError(f"{path} is broken: its table of chunks is not after its points.")
        _fetch(address, file, table, size)
        file.truncate(size)
        file.flush()
        ranges = isolated(las.ranges_of_bytes, path, area)
        wanted = sum(stop - start for start, stop in ranges)
        read = HEAD + size - table + wanted
        print(f"reading {read / 1e6:,.1f} of {size / 1e6:,.1f} MB")
        for start, stop in ranges:
            _fetch(address, file, start, min(stop, size))


def _fetch(address: str, file: BinaryIO, start: int, stop: int) -> int:
    """Copy bytes of a file to their place, and return how many bytes the file has."""
    bytes_wanted = f"bytes={start}-{stop - 1}"
    asked = Request(address, headers={"Range": bytes_wanted})
    try:
        with urlopen(asked, timeout=PATIENCE) as answer:
            if answer.status != 206:
                raise UserError(f"{address}: the server sends whole files only. Download it.")
            content_range = answer.headers["Content-Range"]
            size = int(content_range.rpartition("/")[2])
            file.seek(start)
            left = min(stop, size) - start
            while block := answer.read(min(BLOCK, left)):
                left -= file.write(block)
    except HTTPError as error:
        error.close()
        reason = f"{error.code} {error.reason}"
        raise UserError(f"{address}: the server answers {reason}.") from None
    except (OSError, HTTPException) as error:
        raise UserError(f"{address}: {one_line(error)}.") from None
    if left:
        raise UserError(f"{address}: the server sent {left:,} bytes too few. Try again.")
    return size
