"""Archives unpacked in one step, or not at all."""

import gzip
import shutil
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO

from mops_lightning.errors import UserError

BROKEN = (
    zipfile.BadZipFile,
    tarfile.TarError,
    gzip.BadGzipFile,
    zlib.error,
    EOFError,
    RuntimeError,  # encrypted, or packed by a method that Python does not know
)


def unpack(archive: Path, folder: Path) -> None:
    """Unpack a zip or tar.gz file; the folder appears in one step, whole.

    Where the archive holds nothing but one folder, that folder's content becomes ``folder``.

    Args:
        archive: the file; its content tells which kind it is.
        folder: must be missing or empty.

    Raises:
        UserError: the archive is broken, holds links or names that leave the folder, or the folder
            is in use.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(
            f"Cannot unpack {archive.name}: {folder} is in use. Move it out of the way."
        )
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as name:
            content = Path(name) / "content"  # mkdir's permissions, not those of a private folder
            content.mkdir()
            for member, stream in _members(archive):
                path = content / member
                if stream is None:
                    path.mkdir(parents=True, exist_ok=True)
                    continue
                path.parent.mkdir(parents=True, exist_ok=True)
                with stream, path.open("xb") as file:
                    shutil.copyfileobj(stream, file, 1 << 20)
            inside = [entry for entry in content.iterdir() if entry.name != "__MACOSX"]
            alone = len(inside) == 1 and inside[0].is_dir()
            (inside[0] if alone else content).replace(folder)
    except BROKEN as error:
        raise UserError(
            f"{archive} is broken ({str(error) or 'it ends early'}). Remove it and fetch it again."
        ) from error
    except OSError as error:
        raise UserError(f"Cannot unpack {archive} into {folder}: {error}.") from error


def _members(archive: Path) -> Iterator[tuple[str, IO[bytes] | None]]:
    """Yield the checked name of each member and its bytes, or None for a folder."""
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as packed:
            for info in packed.infolist():
                link = info.external_attr >> 28 == 0o12
                _check_member(archive, info.filename, link)
                yield info.filename, None if info.is_dir() else packed.open(info)
    elif tarfile.is_tarfile(archive):
        with tarfile.open(archive) as tar:
            for member in tar:
                _check_member(archive, member.name, not (member.isfile() or member.isdir()))
                yield member.name, tar.extractfile(member) if member.isfile() else None
            # The checksum stands behind the last member, and only reading on compares it.
            while tar.fileobj and tar.fileobj.read(1 << 20):
                pass
    else:
        raise UserError(
            f"{archive} is neither a zip nor a tar file, or is cut off. Remove it and fetch it "
            "again."
        )


def _check_member(archive: Path, name: str, special: bool) -> None:
    for path in (PurePosixPath(name), PureWindowsPath(name)):
        if path.anchor or ".." in path.parts:
            raise UserError(f"{archive} holds {name!r}, which leaves its folder. Do not trust it.")
    if special:
        raise UserError(f"{archive} holds {name!r}, which is neither a file nor a folder.")
