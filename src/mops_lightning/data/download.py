"""Files from the network, from the first mirror that serves them whole."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pooch
from filelock import FileLock
from requests.exceptions import RequestException

from mops_lightning.errors import UserError

TIMEOUT = 60.0
"""Seconds without a byte after which a mirror is given up."""


def fetch(urls: Sequence[str], target: Path, known_hash: str | None = None, tries: int = 2) -> None:
    """Download a file, unless it exists.

    The file appears at ``target`` only when it is whole and its hash is right. A broken download is
    started again from its first byte; partial files are deleted, not resumed.

    Args:
        urls: http or https addresses of the same file, tried in turn.
        target: path of the file.
        known_hash: hexadecimal sha256 of the file, or another hash as ``md5:...``; None accepts any
            content.
        tries: how many times to go through the mirrors. One that does not have the file, or has
            another one, is asked only once.

    Raises:
        UserError: no mirror served the file (the answer of each is listed), the file exists with
            another hash, or it cannot be written.
    """
    if isinstance(urls, str) or not urls:
        raise UserError(f"The addresses to download {target.name} from must be a list, got {urls}.")
    for url in urls:
        if not url.startswith(("http://", "https://")):
            raise UserError(f"A download address must start with http:// or https://, got {url!r}.")
    if target.exists():
        _check_existing(target, known_hash)
        return
    answers: dict[str, str] = {}
    final: set[str] = set()
    for url in [*urls] * tries:
        if url in final:
            continue
        try:
            _download(url, target, known_hash)
        except RequestException as error:  # before OSError, of which it is one
            answers[url] = f"{type(error).__name__}: {error}"
            if error.response is not None and error.response.status_code < 500:
                final.add(url)
        except OSError as error:
            raise UserError(f"Cannot write the download {target}: {error}.") from error
        except ValueError as error:
            answers[url] = str(error).splitlines()[0]
            final.add(url)
        else:
            return
    raise UserError(
        "\n".join([f"No mirror served {target.name}:", *(f"  {u}: {answers[u]}" for u in urls)])
        + f"\nCheck the network and try again, or save the file as {target} yourself."
    )


def _download(url: str, target: Path, known_hash: str | None) -> None:
    """Download from one mirror into a temporary file, check the hash, and rename the file."""
    pooch.get_logger().setLevel("WARNING")  # it would advise to copy the hash of what it got
    downloader = pooch.HTTPDownloader(
        progressbar=sys.stderr.isatty(),
        chunk_size=1 << 16,
        timeout=TIMEOUT,
        headers={"User-Agent": "mops-lightning", "Accept-Encoding": "identity"},
    )
    pooch.retrieve(url, known_hash, target.name, target.parent, downloader=downloader)


def _check_existing(target: Path, known_hash: str | None) -> None:
    if known_hash is not None and not pooch.hashes.hash_matches(target, known_hash):
        found = pooch.file_hash(target, pooch.hashes.hash_algorithm(known_hash))
        raise UserError(
            f"{target} exists with hash {found}, expected {known_hash}. "
            "Remove it to download it again."
        )


@contextmanager
def one_at_a_time(path: Path) -> Iterator[None]:
    """Let processes that want the same download wait for the first one.

    Sweeps and distributed runs start several at once; inside the block, the later ones should check
    whether anything is left to download. A process that is killed releases the lock.

    Args:
        path: an empty file, created with its folder and kept.

    Raises:
        UserError: the folder cannot be written.
    """
    lock = FileLock(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except OSError as error:
        raise UserError(f"Cannot download into {path.parent}: {error}.") from error
    try:
        yield
    finally:
        lock.release()
