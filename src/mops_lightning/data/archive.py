"""Atomic unpacking of archives."""

import gzip
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO

from mops_lightning.errors import UserError, one_line
from mops_lightning.filesystem import memory

MAX_MEMBERS = 1_000_000


def unpack(archive: Path, folder: Path) -> None:
    """Unpack a zip or tar.gz file; the folder is created completely or not at all.

    If the archive has a single top-level folder, the content of that folder becomes ``folder``.

    Args:
        archive: the file; its format is detected from its content.
        folder: must be missing or empty.

    Raises:
        UserError: the archive is damaged or has unsafe members, or the folder is not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"Cannot unpack {archive.name}: {folder} is not empty. Empty it.")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as name:
            content = Path(name) / "content"  # with default permissions
            content.mkdir()
            room = memory(archive)
            for number, (member, stream) in enumerate(_members(archive)):
                if number >= MAX_MEMBERS:
                    raise UserError(f"{archive} has more than {MAX_MEMBERS:,} members.")
                path = content / member
                if stream is None:
                    path.mkdir(parents=True, exist_ok=True)
                    continue
                path.parent.mkdir(parents=True, exist_ok=True)
                with stream, path.open("xb") as file:
                    room = _copy(archive, stream, file, room)
            inside = [entry for entry in content.iterdir() if entry.name != "__MACOSX"]
            alone = len(inside) == 1 and inside[0].is_dir()
            (inside[0] if alone else content).replace(folder)
    except UserError:
        raise
    except OSError as error:
        if isinstance(error, gzip.BadGzipFile):
            raise _damaged(archive, error) from error
        raise UserError(f"Cannot unpack {archive} into {folder}: {error}.") from error
    except Exception as error:  # zip and tar files have many ways to be damaged
        raise _damaged(archive, error) from error


def _damaged(archive: Path, error: Exception) -> UserError:
    return UserError(f"{archive} is damaged ({one_line(error)}). Remove it and download it again.")


def _copy(archive: Path, stream: IO[bytes], file: IO[bytes], room: int) -> int:
    """Copy a member and return how many bytes the rest may take.

    Raises:
        UserError: the archive unpacks to much more than its length.
    """
    while piece := stream.read(1 << 20):
        room -= len(piece)
        if room < 0:
            raise UserError(
                f"{archive} unpacks to more than {memory(archive):,} bytes, the limit for an "
                "archive of its length. If you trust it, unpack it yourself."
            )
        file.write(piece)
    return room


def _members(archive: Path) -> Iterator[tuple[str, IO[bytes] | None]]:
    """Yield the checked name of each member and its bytes, or None for a folder."""
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as packed:
            for info in packed.infolist():
                link = info.external_attr >> 28 == 0o12
                _check_member(archive, info.filename, link)
                yield info.filename, None if info.filename.endswith("/") else packed.open(info)
    elif tarfile.is_tarfile(archive):
        with tarfile.open(archive) as tar:
            for member in tar:
                _check_member(archive, member.name, not (member.isfile() or member.isdir()))
                yield member.name, tar.extractfile(member) if member.isfile() else None
            # The checksum follows the last member and is verified by reading to the end.
            while tar.fileobj and tar.fileobj.read(1 << 20):
                pass
    else:
        raise UserError(
            f"{archive} is neither a zip nor a tar file, or is truncated. Remove it and download "
            "it again."
        )


def _check_member(archive: Path, name: str, special: bool) -> None:
    if not PurePosixPath(name).parts:
        raise UserError(f"{archive} has a member without a name; it is damaged.")
    for path in (PurePosixPath(name), PureWindowsPath(name)):
        if path.anchor or ".." in path.parts:
            raise UserError(
                f"{archive} would write {name!r} outside the target folder; the archive is unsafe."
            )
    if special:
        raise UserError(f"{archive} contains {name!r}, which is neither a file nor a folder.")
