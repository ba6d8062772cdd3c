"""Text files: .xyz and .txt with one point per line."""

import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.columns import from_columns, unique_names, unnamed
from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.table import Column, Table

COMMENT = re.compile("#|//")

HEADER_LINES = 20
"""The names of the columns are in one of so many lines."""


@dataclass(frozen=True)
class TextForm:
    """How a text file is written.

    Attributes:
        separator: of the numbers in a line.
        header: the line with the names, as it is; empty: there is none.
        names: of the columns in the order of the file; x, y and z are named so.
        counted: whether the first line is the number of points.
    """

    separator: str = " "
    header: str = ""
    names: tuple[str, ...] = ()
    counted: bool = False


def read(path: Path) -> Table:
    """Read rows of numbers separated by spaces, commas or semicolons, with or without a header.

    A column of whole numbers without a point is int64 or uint64, others are float64.

    Raises:
        BadCloudError: the file has no points, or fewer than its first line announces.
    """
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    lines = _lines_of_numbers(text)
    if not lines:
        raise BadCloudError(f"{path} is empty.")
    separator = _separator(lines[-1])
    announced = None
    first_words = lines[0].split(separator)
    is_count = len(first_words) == 1 and lines[0].isdecimal()
    if is_count and len(lines) > 1:
        announced = int(lines.pop(0))
    words = _words(lines[0], separator)
    if any(map(_is_number, words)):
        words = []
    else:
        lines.pop(0)
    if not lines:
        raise BadCloudError(f"{path} holds no points.")
    columns = numbers_of_lines(lines, separator)
    number = len(columns[0])
    if announced is not None and number < announced:
        raise BadCloudError(f"{path} is broken: it announces {announced} points, but has {number}.")
    if len(columns) < 3:
        raise BadCloudError(f"{path} must hold rows of x, y, z, got {len(columns)} columns.")
    header, names = _header(text, separator, words, len(columns))
    table = from_columns(dict(zip(names, columns, strict=True)), path)
    blank = " "
    if "\t" in lines[-1]:
        blank = "\t"
    layout = TextForm(
        separator=separator or blank,
        header=header,
        names=tuple(_name_in_table(name, table) for name in names),
        counted=announced is not None,
    )
    return replace(table, form=replace(table.form, layout=layout))


def _lines_of_numbers(text: str) -> list[str]:
    """Return the lines of a text without comments and empty lines."""
    lines = []
    for line in text.splitlines():
        content = COMMENT.split(line)[0].strip()
        if content:
            lines.append(content)
    return lines


def _separator(line: str) -> str | None:
    """Return the mark between the numbers of a line; None for blanks."""
    if "," in line:
        return ","
    if ";" in line:
        return ";"
    return None


def _name_in_table(name: str, table: Table) -> str:
    if name in table.columns:
        return name
    return name.lower()


def _words(line: str, separator: str | None) -> list[str]:
    """Return the words of a line, without the quotes around them."""
    words = line.split(separator)
    if separator is None:  # quotes may hold blanks
        words = re.findall(r'"[^"]*"|\S+', line)
    return [word.strip().strip("\"'") for word in words]


def _header(
    text: str, separator: str | None, words: list[str], number: int
) -> tuple[str, list[str]]:
    """Return the line with the names of the columns, and a different name for every column.

    Args:
        text: the whole file.
        separator: of words; None: blanks.
        words: of the first line that is no comment, if it has no numbers.
        number: of columns.
    """
    for line in text.lstrip("\ufeff").splitlines()[:HEADER_LINES]:
        # A header may be a comment: as many words as there are columns, x, y and z among them.
        names = _words(line.strip().lstrip("#/ "), separator)
        if len(names) != number:
            continue
        if {"x", "y", "z"} <= {name.lower() for name in names}:
            return line, _different(names)
        if words and names == words:
            return line, _different(["x", "y", "z", *words[3:]])
    return "", unnamed(number)


def _different(names: list[str]) -> list[str]:
    """Return the names, those that are there already with a ``_`` appended."""
    different: list[str] = []
    for name in names:
        own = name or "column"
        while own in different:
            own += "_"
        different.append(own)
    return different


def numbers_of_lines(lines: list[str], separator: str | None) -> list[Column]:
    """Return the columns of lines; whole numbers of 64 bits keep all digits."""
    array: NDArray[Any] = np.loadtxt(lines, delimiter=separator, ndmin=2)
    columns: list[Column] = []
    for number, values in enumerate(array.T):
        column: Column = values
        if np.isfinite(values).all() and (values == np.rint(values)).all():
            integers = _integers(lines, separator, number)
            if integers is not None:
                column = integers
        columns.append(column)
    return columns


def _integers(lines: list[str], separator: str | None, place: int) -> Column | None:
    """Return a column as integers; None where a number is written with a point or too large."""
    for kind in (np.int64, np.uint64):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # numpy reads 1.0 as 1, with a warning
                return np.loadtxt(lines, kind, delimiter=separator, usecols=place, ndmin=1)
        except (ValueError, OverflowError, DeprecationWarning):
            continue
    return None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def write(path: Path, table: Table) -> None:
    """Write the coordinates and columns, one point per line.

    Every number has as few digits as give the same number of its data type. Separator and names are
    those of a text file that was read.
    """
    form = table.form.layout
    if not isinstance(form, TextForm):
        form = TextForm()
    names = ["x", "y", "z", *table.columns]
    order = _order(names, form)
    header = form.header
    if tuple(names[column] for column in order) != form.names:
        plain = ["x", "y", "z", *unique_names(table)]
        header = _new_header(form, [plain[column] for column in order])
    columns = [*table.stored_coordinates().T, *table.columns.values()]
    words = [_shortest(columns[column]) for column in order]
    lines = map(form.separator.join, zip(*words, strict=True))
    with path.open("w", encoding="utf-8", newline="\n") as file:
        if form.counted:
            file.write(f"{len(table.points)}\n")
        if header:
            file.write(f"{header}\n")
        file.writelines(f"{line}\n" for line in lines)


def _order(names: list[str], form: TextForm) -> list[int]:
    """Return the numbers of columns in the order of the file that was read, new columns last."""
    order = [names.index(name) for name in form.names if name in names]
    for column in range(len(names)):
        if column not in order:
            order.append(column)
    return order


def _is_of_unnamed(name: str) -> bool:
    return name in ("x", "y", "z") or name.startswith("column_")


def _new_header(form: TextForm, names: list[str]) -> str:
    """Return a line of names; none if all names are those of unnamed columns."""
    are_unnamed = all(_is_of_unnamed(name) for name in names)
    if are_unnamed and not form.header:
        return ""
    line = form.separator.join(names)
    if not form.header or COMMENT.match(form.header):
        return f"# {line}"
    return line


def _shortest(column: Column) -> list[str]:
    """Return the numbers of a column as text, with as few digits as keep them."""
    if column.dtype.kind == "b":
        column = column.astype(np.uint8)
    if column.dtype.kind in "iu":
        return [str(number) for number in column.tolist()]
    if column.dtype == np.float64:
        return [repr(number).removesuffix(".0") for number in column.tolist()]
    words = column.astype("U48")  # numpy's text of a float32 gives the same float32
    return [word.removesuffix(".0") for word in words.tolist()]
