"""Files from the network: fetched from the first mirror that serves them whole."""

import hashlib
import http.client
import json
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from mops_lightning.errors import UserError
from mops_lightning.files import atomic_write, lock

TIMEOUT = 60.0  # seconds without a byte
CHUNK = 1 << 16


class _Refused(Exception):
    """A mirror's answer that is not the file; ``again`` says whether to ask it once more."""

    def __init__(self, answer: str, again: bool) -> None:
        super().__init__(answer)
        self.again = again


def fetch(
    urls: Sequence[str],
    target: Path,
    sha256: str | None = None,
    size: int | None = None,
    tries: int = 4,
    pause: float = 1.0,
) -> None:
    """Download a file, unless it is there already.

    What arrives is kept in ``TARGET.part`` and the next call goes on from there;
    ``TARGET.part.json`` remembers which mirror and which version the bytes came from, so that two
    different files are never joined. Every answer is checked against the length that the server
    announces.

    Args:
        urls: http or https addresses of the same file, tried in turn.
        target: where to put it; moved there in one step when whole.
        sha256: hexadecimal hash that it must have, or None.
        size: bytes that it must have, or None.
        tries: how often to ask a mirror that fails in a way that may pass.
        pause: seconds before the second try, doubled for each further one.

    Raises:
        UserError: no mirror served the file, with the answer of each; or the file is there already
            and is another one; or it cannot be written.
    """
    if isinstance(urls, str) or not urls:
        raise UserError(f"The addresses to download {target.name} from must be a list, got {urls}.")
    for url in urls:
        if not url.startswith(("http://", "https://")):
            raise UserError(f"A download address must start with http:// or https://, got {url!r}.")
    if target.exists():
        if wrong := _wrong(target, sha256, size):
            raise UserError(f"{target} exists, but {wrong}. Remove it to download it again.")
        return
    answers = []
    for url in urls:
        for attempt in range(tries):
            if attempt:
                time.sleep(pause * 2 ** (attempt - 1))
            try:
                part = _attempt(url, target, sha256, size)
            except _Refused as refused:
                answer = f"{refused} (asked {attempt + 1} times)" if attempt else str(refused)
                if not refused.again:
                    break
            except OSError as error:
                raise UserError(f"Cannot write the download {target}: {error}.") from error
            else:
                part.replace(target)
                _memo(part).unlink(missing_ok=True)
                return
        answers.append(f"  {url}: {answer}")
    raise UserError(
        "\n".join([f"No mirror served {target.name}:", *answers])
        + "\nCheck the network and try again (what has arrived is kept), or put the file at "
        f"{target} by hand."
    )


@contextmanager
def one_at_a_time(path: Path) -> Iterator[None]:
    """Let processes that want the same download wait for the first one.

    Sweeps and distributed runs start several at once; the later ones should look again, inside
    the block, whether anything is left to do.

    Args:
        path: an empty file that is made and stays; its folder is made when missing.

    Raises:
        UserError: the folder cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a")
    except OSError as error:
        raise UserError(f"Cannot download into {path.parent}: {error}.") from error
    with file:
        lock(file)
        yield


def _memo(part: Path) -> Path:
    return part.with_name(part.name + ".json")


def _attempt(url: str, target: Path, sha256: str | None, size: int | None) -> Path:
    """Ask one mirror once and return the whole, checked ``.part`` file."""
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(target.name + ".part")
    start, memo = _resumable(part, url)
    headers = {"User-Agent": "mops-lightning", "Accept-Encoding": "identity"}
    if start:
        headers["Range"] = f"bytes={start}-"
        if memo["version"]:
            headers["If-Range"] = memo["version"]
    try:
        with _network():
            response = urlopen(Request(url, headers=headers), timeout=TIMEOUT)
    except _Refused as refused:
        cause = refused.__cause__
        if start and isinstance(cause, HTTPError) and cause.code == 416:
            # Nothing follows the bytes we have: they are the whole file, or they are not this file.
            if cause.headers.get("Content-Range", "").strip() == f"bytes */{start}":
                return _checked(part, sha256, size, resumed=True)
            _forget(part)
            raise _Refused("has no such range", again=True) from cause
        raise
    with response:
        begin, total = _extent(response, start)
        if begin is None or (begin and memo["total"] not in (None, total)):
            _forget(part)
            raise _Refused(f"sent HTTP {response.status}, not the bytes asked for", again=True)
        if size is not None and total not in (None, size):
            raise _Refused(f"serves {total} bytes, expected {size}", again=False)
        if not begin:
            _forget(part)
            tags = [response.headers.get(name) for name in ("ETag", "Last-Modified")]
            # If-Range takes strong validators only, and a weak one starts with W/.
            version = next((tag for tag in tags if tag and not tag.startswith("W/")), None)
            with atomic_write(_memo(part)) as path:
                path.write_text(json.dumps({"url": url, "version": version, "total": total}))
        _receive(response, part, begin, total)
    return _checked(part, sha256, size, resumed=begin > 0)


def _resumable(part: Path, url: str) -> tuple[int, dict[str, Any]]:
    """Return how many bytes of this very address are there, and what was noted about it."""
    none = {"version": None, "total": None}
    try:
        memo = json.loads(_memo(part).read_text(encoding="utf-8"))
        if memo["url"] != url:
            return 0, none
        return part.stat().st_size, {key: memo[key] for key in none}
    except (OSError, ValueError, KeyError, TypeError):
        return 0, none


def _forget(part: Path) -> None:
    part.unlink(missing_ok=True)
    _memo(part).unlink(missing_ok=True)


def _extent(response: Any, start: int) -> tuple[int | None, int | None]:
    """Return where the answer's bytes begin and how long the file is, if the server says so.

    A server that knows no ranges sends all of it; None stands for an answer that is of no use.
    """
    if response.status == 200:
        return 0, response.length
    span = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", response.headers.get("Content-Range", ""))
    if response.status != 206 or not span or int(span[1]) != start:
        return None, None
    if span[2] != "*":
        return start, int(span[2])
    return start, None if response.length is None else start + response.length


def _receive(response: Any, part: Path, start: int, total: int | None) -> None:
    console = Console(stderr=True)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )
    with bar, part.open("ab" if start else "wb") as file:
        task = bar.add_task(part.stem, total=total, completed=start)
        while True:
            with _network():
                chunk = response.read(CHUNK)
            if not chunk:
                break
            file.write(chunk)
            bar.advance(task, len(chunk))
        got = file.tell()
    if total is not None and got < total:
        raise _Refused(f"broke off after {got} of {total} bytes", again=True)


def _checked(part: Path, sha256: str | None, size: int | None, resumed: bool) -> Path:
    if wrong := _wrong(part, sha256, size):
        _forget(part)
        # Old bytes may be at fault where some were there before: then one fresh start is fair.
        raise _Refused(f"what it serves is wrong: {wrong}", again=resumed)
    return part


def _wrong(path: Path, sha256: str | None, size: int | None) -> str | None:
    if size is not None and path.stat().st_size != size:
        return f"it has {path.stat().st_size} bytes, expected {size}"
    if sha256 is not None:
        with path.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
        if found != sha256.lower():
            return f"its sha256 is {found}, expected {sha256.lower()}"
    return None


@contextmanager
def _network() -> Iterator[None]:
    """Turn whatever goes wrong on the way to a mirror into its answer."""
    try:
        yield
    except HTTPError as error:
        error.close()
        again = error.code >= 500 or error.code in (408, 429)
        raise _Refused(f"HTTP {error.code} {error.reason}", again) from error
    except (URLError, http.client.HTTPException, OSError, ValueError) as error:
        reason = getattr(error, "reason", None) or error
        # A misspelt address stays misspelt.
        again = not isinstance(error, http.client.InvalidURL | ValueError)
        raise _Refused(f"{type(error).__name__}: {reason}", again) from error
