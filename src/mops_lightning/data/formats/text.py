"""Text files: .xyz and .txt with one point per line."""

import re
from pathlib import Path

import numpy as np

from mops_lightning.data.formats import table as tables
from mops_lightning.data.formats.guard import BadCloudError


def read(path: Path) -> tables.Table:
    """Read rows of numbers separated by spaces, commas or semicolons, with or without a header.

    Raises:
        BadCloudError: the file has no points, or fewer than its first line announces.
    """
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    lines = [re.split("#|//", line)[0].strip() for line in text.splitlines()]
    lines = [line for line in lines if line]
    if not lines:
        raise BadCloudError(f"{path} is empty.")
    separator = next((mark for mark in ",;" if mark in lines[-1]), None)
    announced = 0
    if len(lines) > 1 and len(lines[0].split(separator)) == 1 and lines[0].isdecimal():
        announced = int(lines.pop(0))
    if not any(map(_is_number, lines[0].split(separator))):
        lines.pop(0)  # a header
    if not lines:
        raise BadCloudError(f"{path} holds no points.")
    array = np.loadtxt(lines, delimiter=separator, ndmin=2)
    if len(array) < announced:
        raise BadCloudError(
            f"{path} is broken: it announces {announced} points, but has {len(array)}."
        )
    # A header may be a comment: as many words as there are columns, x, y and z among them.
    for line in text.lstrip("\ufeff").splitlines()[:20]:
        words = [word.strip() for word in line.strip().lstrip("#/ ").split(separator)]
        if len(words) == array.shape[1] and {"x", "y", "z"} <= {word.lower() for word in words}:
            first = {word: words.index(word) for word in words}  # a name may be there twice
            return tables.from_columns(
                {word: array[:, place] for word, place in first.items()}, path
            )
    return tables.from_array(array, path)


def write(path: Path, table: tables.Table) -> None:
    """Write ``x y z`` and the columns, separated by spaces, without loss of digits."""
    columns = tables.to_columns(table)
    unnamed = all(name.startswith("column_") for name in list(columns)[3:])
    header = "" if unnamed else " ".join(columns)
    formats = [_number_format(column) for column in columns.values()]
    np.savetxt(path, tables.to_rows(columns), fmt=formats, header=header, comments="# ")


def _number_format(column: tables.Column) -> str:
    """Return the shortest ``%`` format that keeps every number of a column."""
    if column.dtype.kind != "f":
        return "%d"
    short = column.dtype.itemsize <= 4 or np.array_equal(column.astype("f4"), column)
    return "%.9g" if short else "%.17g"


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
