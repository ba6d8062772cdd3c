"""Limits for what a file of tensors may hold: a small file cannot announce a large content."""

import zipfile
from pathlib import Path
from typing import Any

from torch import Tensor

TIMES, SMALL = 16, 1 << 20
"""Most bytes of the content per byte of the file, and in addition: files may be compressed, and
tensors may share their bytes."""

MAX_VALUES = 2_000_000
"""Most values in nested plain data. A list that contains one list many times counts each time."""


def check_archive(path: Path) -> None:
    """Reject a file that is no zip file, the format of ``torch.save``, or unpacks to much more.

    Raises:
        ValueError: it is of another format, or its members are much larger than the file.
    """
    with zipfile.ZipFile(path) as packed:
        announced = sum(info.file_size for info in packed.infolist())
    if announced > _limit(path):
        raise ValueError("members that are much larger than the file")


def check_content(content: Any, path: Path) -> None:
    """Reject tensors and nested data that are much larger than their file.

    Raises:
        ValueError: they are.
    """
    room = _limit(path)
    values, waiting = 0, [content]
    while waiting:
        value = waiting.pop()
        values += 1
        if isinstance(value, dict):
            waiting.extend(value)
            waiting.extend(value.values())
        elif isinstance(value, list | tuple | set | frozenset):
            waiting.extend(value)
        elif isinstance(value, Tensor):
            room -= value.numel() * value.element_size()
        elif isinstance(value, str | bytes | bytearray):
            room -= len(value)
        if room < 0 or values + len(waiting) > MAX_VALUES:
            raise ValueError("content that is larger than the file")


def _limit(path: Path) -> int:
    return TIMES * path.stat().st_size + SMALL
