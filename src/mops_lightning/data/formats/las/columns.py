"""The columns of packed points, unpacked when they are asked for."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.las.header import Header
from mops_lightning.data.formats.las.layout import Layout, Rows
from mops_lightning.data.formats.table import Column, Form, PackedColumns, Table


class LasColumns(PackedColumns):
    """The columns of points as they are packed in their file.

    Written to a file of the same kind again, the points keep all their bytes.

    Attributes:
        rows: ``(N,)`` packed points.
        layout: their dimensions.
        changes: columns ``(N,)`` in place of those in ``rows``, or beside them.
    """

    def __init__(
        self,
        rows: Rows,
        layout: Layout,
        changes: Mapping[str, Column] | None = None,
    ) -> None:
        self.rows = rows
        self.layout = layout
        self.changes = dict(changes or {})

    def __getitem__(self, name: str) -> Column:
        if name in self.changes:
            return self.changes[name]
        return self.layout.dimensions[name].get(self.rows)

    def __iter__(self) -> Iterator[str]:
        names = [*self.layout.dimensions, *self.changes]
        return iter(dict.fromkeys(names))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def take(self, rows: NDArray[np.int64]) -> "LasColumns":
        """Return the columns of some points."""
        changes = {name: column[rows] for name, column in self.changes.items()}
        return LasColumns(self.rows[rows], self.layout, changes)

    def replaced(self, columns: Mapping[str, Column]) -> "LasColumns":
        """Return the columns with others in their place, or beside them."""
        changes = {**self.changes, **columns}
        return LasColumns(self.rows, self.layout, changes)

    def joined(self, others: "Sequence[Any]") -> "LasColumns":
        """Return these columns followed by those of other points of the same file."""
        parts = [self, *others]
        changes = {}
        for name in self.changes:
            changes[name] = np.concatenate([part.changes[name] for part in parts])
        rows = np.concatenate([part.rows for part in parts])
        return LasColumns(rows, self.layout, changes)


def table_of(header: Header, layout: Layout, rows: Rows) -> Table:
    """Make a table of packed points; coordinates are scaled and shifted."""
    coordinates = []
    for axis, scale, offset in zip("XYZ", header.scales, header.offsets, strict=True):
        coordinates.append(rows[axis] * scale + offset)
    points = np.stack(coordinates, 1)
    form = Form(arrays=layout.arrays)
    return Table(points, LasColumns(rows, layout), form=form)
