"""Files whose rows can be read in any range, so that they need not fit in memory."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.columns import from_array
from mops_lightning.data.formats.guard import BadCloudError, ends_early, reading
from mops_lightning.data.formats.table import Table, join_tables

PART = 500_000
"""Number of rows that are read at a time."""


@dataclass(frozen=True)
class CloudFile:
    """A file whose rows can be read in any range, so that it need not fit in memory.

    Attributes:
        path: the file.
        number: how many points it has, including those with non-finite coordinates.
        parse: reads a range of rows, or fewer where the file ends too early.
        header: see ``Table``; the tables that are read have none.
        area: the part of the file to read.
    """

    path: Path
    number: int
    parse: Callable[[Path, range], Table]
    header: Any = None
    area: Area | None = None

    def row_ranges(self, size: int) -> list[range]:
        """Split the rows into ranges of up to ``size``."""
        starts = range(0, self.number, size)
        ranges = []
        for start in starts:
            stop = min(start + size, self.number)
            ranges.append(range(start, stop))
        return ranges

    def read(self, rows: range) -> Table:
        """Read a range of rows, without the points that are not finite or outside of the area.

        Raises:
            BadCloudError: the file is missing or broken, or ends too early.
        """
        with reading(self.path):
            table = self.parse(self.path, rows)
            if len(table.points) < len(rows):
                raise ends_early(self.path, rows.start + len(table.points))
            table = table.finite()
            if self.area is None:
                return table
            return self.area.clip(table, self.path)

    def read_all(self) -> Table:
        """Read all rows, range by range; see ``read``."""
        tables = [self.read(rows) for rows in self.row_ranges(PART)]
        return replace(join_tables(tables), header=self.header)


def binary_file(path: Path, number: int, kind: np.dtype[Any], offset: int = 0) -> CloudFile:
    """Return a file whose points are rows of a fixed number of bytes.

    Args:
        path: the file.
        number: of rows.
        kind: the data type of a row, with the names of the columns.
        offset: of the first row, in bytes.

    Raises:
        BadCloudError: the file is too short for its rows.
    """
    if not kind.itemsize or number < 0:
        raise BadCloudError(f"{path} is broken: {number} points of {kind}.")
    available = max(path.stat().st_size - offset, 0)
    room = available // kind.itemsize
    if number > room:
        raise ends_early(path, room)
    return CloudFile(path, number, partial(_parse_rows, kind, offset))


def _parse_rows(kind: np.dtype[Any], offset: int, path: Path, rows: range) -> Table:
    start = offset + rows.start * kind.itemsize
    numbers = np.fromfile(path, kind, len(rows), offset=start)
    return from_array(numbers, path)
