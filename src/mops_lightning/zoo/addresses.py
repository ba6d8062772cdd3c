"""Models at web addresses, which are downloaded once and pinned by their hash."""

import os
import re
import sys
from http.client import HTTPException
from pathlib import Path
from typing import NamedTuple

import pooch

from mops_lightning.errors import UserError, one_line
from mops_lightning.zoo import model_file

SCHEMES = ("https://", "http://")
HASH = "#sha256="
"""Between the address of a file and the sha256 of its bytes."""
EXAMPLE = f"https://example.org/fmops.chairs-m64{model_file.SUFFIX}{HASH}0123…"
TIMEOUT = 60.0
"""Seconds without a byte after which a download is given up."""


class Address(NamedTuple):
    """A file on the web.

    Attributes:
        url: where it is.
        name: its file name.
        sha256: the hash of its bytes, in hexadecimal digits.
    """

    url: str
    name: str
    sha256: str


def is_address(text: str) -> bool:
    """Return whether a reference to a model is a web address."""
    return text.startswith(SCHEMES)


def parse(text: str) -> Address:
    """Split ``https://…/NAME.safetensors#sha256=HASH``.

    Raises:
        UserError: the file is not called like a model, or the hash is missing or not one.
    """
    url, _, sha256 = text.partition(HASH)
    name = url.partition("?")[0].rpartition("/")[2]
    if not name.endswith(model_file.SUFFIX):
        raise UserError(
            f"{url}: a model's file ends in {model_file.SUFFIX}. Give an address like {EXAMPLE}"
        )
    if not re.fullmatch("[0-9a-fA-F]{64}", sha256):
        given = f"got {sha256!r:.80}" if sha256 else "got none"
        raise UserError(
            f"{url}: the address of a model must end in {HASH} and the 64 hexadecimal digits that "
            f"sha256sum prints for the file, {given}. They pin the weights: ask the publisher."
        )
    return Address(url, name, sha256.lower())


def fetch(text: str) -> Path:
    """Return the local copy of a file on the web, which is downloaded if there is none.

    Copies are kept below ``MOPS_CACHE``, by default ``~/.cache/mops_lightning``, and compared with
    the hash at every use.

    Raises:
        UserError: the address is not valid, the file cannot be had, or it has another hash.
    """
    address = parse(text)
    cache = Path(os.environ.get("MOPS_CACHE", "~/.cache/mops_lightning")).expanduser()
    folder = cache / "models" / address.sha256
    pooch.get_logger().setLevel("WARNING")
    downloader = pooch.HTTPDownloader(progressbar=sys.stderr.isatty(), timeout=TIMEOUT)
    known = f"sha256:{address.sha256}"
    try:
        path = pooch.retrieve(address.url, known, address.name, folder, downloader=downloader)
    except (OSError, HTTPException) as error:
        raise UserError(f"{address.url}: {one_line(error)}") from None
    except ValueError as error:  # the file has another hash; both are in the message
        message = " ".join(str(error).split())
        raise UserError(f"{address.url}: {message}") from None
    return Path(path)
