"""Cloud files of which any range of rows can be read alone, so that they need not fit in memory."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mops_lightning.data.formats.errors import BadCloudError, ends_early, naming_file
from mops_lightning.data.formats.limits import limited
from mops_lightning.data.formats.table import Table, from_array


@dataclass(frozen=True, kw_only=True)
class CloudFile(ABC):
    """A file and the number of its points.

    Attributes:
        path: the file.
        number: how many points it has, including those with non-finite coordinates.
        header: see ``Table``; the tables that are read have none.
    """

    path: Path
    number: int
    header: Any = None

    def row_ranges(self, size: int) -> list[range]:
        """Split the rows into ranges of up to ``size``."""
        starts = range(0, self.number, size)
        return [range(start, min(start + size, self.number)) for start in starts]

    def read(self, rows: range) -> Table:
        """Read a range of rows, without the points that are not finite.

        Raises:
            BadCloudError: the file is broken or missing.
        """
        with limited(self.path), naming_file(self.path):
            return self.read_all(rows).finite()

    def read_all(self, rows: range) -> Table:
        """Read a range of rows with all its points; a parser's own errors pass through.

        Raises:
            BadCloudError: the file ends too early.
        """
        table = self._parse(rows)
        if len(table.points) < len(rows):
            raise ends_early(self.path, rows.start + len(table.points))
        return table

    @abstractmethod
    def _parse(self, rows: range) -> Table:
        """Read a range of rows, or fewer where the file ends too early."""


@dataclass(frozen=True, kw_only=True)
class BinaryCloudFile(CloudFile):
    """A file whose points are rows of a fixed number of bytes.

    Attributes:
        kind: the data type of a row, with the names of the columns.
        offset: of the first row, in bytes.

    Raises:
        BadCloudError: the file is too short for its rows.
    """

    kind: np.dtype[Any]
    offset: int = 0

    def __post_init__(self) -> None:
        """Reject a number of rows that the file is too short for."""
        if not self.kind.itemsize or self.number < 0:
            raise BadCloudError(f"{self.path} is broken: {self.number} points of {self.kind}.")
        room = max(self.path.stat().st_size - self.offset, 0) // self.kind.itemsize
        if self.number > room:
            raise ends_early(self.path, room)

    def _parse(self, rows: range) -> Table:
        start = self.offset + rows.start * self.kind.itemsize
        array = np.fromfile(self.path, self.kind, len(rows), offset=start)
        return from_array(array, list(self.kind.names or ()), self.path)
