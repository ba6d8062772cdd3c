"""The smallest and largest numbers of extra dimensions, where their record names them."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.las.header import Header, Record
from mops_lightning.data.formats.las.layout import EXTRA, Layout, Rows, is_extra

NO_DATA, SMALLEST, LARGEST = 1, 2, 4
"""Bits of an extra dimension's options."""

PLACES = {NO_DATA: 40, SMALLEST: 64, LARGEST: 88}
"""Where the three numbers of each are in an entry of the record."""

WIDE = {"u": "Q", "i": "q", "f": "d"}
"""How a number of each kind is stored: as one of 64 bits, neither scaled nor shifted."""


@dataclass
class Entry:
    """An entry of a record.

    Attributes:
        field: of the packed points.
        kind: of its numbers: u, i or f.
        count: how many numbers a point has.
        options: see ``EXTRA``.
        no_data: ``(count,)`` numbers that stand for no value; None: all are values.
        smallest: ``(count,)`` so far; None: no value yet.
        largest: ``(count,)`` so far.
    """

    field: str
    kind: str
    count: int
    options: int
    no_data: tuple[Any, ...] | None
    smallest: list[Any] | None = None
    largest: list[Any] | None = None

    def add(self, rows: Rows) -> None:
        """Look at the numbers of more points."""
        numbers = rows[self.field].reshape(len(rows), self.count)
        ranges = [self._range(numbers[:, place], place) for place in range(self.count)]
        if any(found is None for found in ranges):
            return  # one of an array's numbers has no value
        low = [found[0] for found in ranges if found is not None]
        high = [found[1] for found in ranges if found is not None]
        if self.smallest is None or self.largest is None:
            self.smallest, self.largest = low, high
            return
        self.smallest = [min(pair) for pair in zip(self.smallest, low, strict=True)]
        self.largest = [max(pair) for pair in zip(self.largest, high, strict=True)]

    def _range(self, numbers: NDArray[Any], place: int) -> tuple[Any, Any] | None:
        """Return the smallest and the largest of the numbers that are values."""
        if self.no_data is not None:
            numbers = numbers[numbers != self.no_data[place]]
        if self.kind == "f":
            numbers = numbers[~np.isnan(numbers)]
        return (numbers.min().item(), numbers.max().item()) if len(numbers) else None

    def fill(self, entry: bytearray) -> None:
        """Write the numbers into an entry of the record."""
        if self.smallest is None or self.largest is None:
            return
        for bit, values in ((SMALLEST, self.smallest), (LARGEST, self.largest)):
            if self.options & bit:
                struct.pack_into(f"<{self.count}{WIDE[self.kind]}", entry, PLACES[bit], *values)


class ExtraRanges:
    """The numbers of all extra dimensions of a file that is written."""

    def __init__(self, header: Header, layout: Layout) -> None:
        self.entries: dict[tuple[int, int], Entry] = {}
        fields = iter(range(len(layout.extra)))
        for record, start, data in _entries(header.records):
            type_, options = data[2], data[3]
            if type_ == 0 and options == 0:
                continue  # takes no bytes, so that the layout lacks it
            place = next(fields, None)
            if place is None:
                break
            if type_ and options & (SMALLEST | LARGEST):
                self.entries[record, start] = _entry(place, layout, data)

    def add(self, rows: Rows) -> None:
        """Look at more points."""
        for entry in self.entries.values():
            entry.add(rows)

    def fill(self, records: tuple[Record, ...]) -> tuple[Record, ...]:
        """Return the records of the file with the numbers of its points."""
        filled = list(records)
        for (place, start), entry in self.entries.items():
            data = bytearray(filled[place].data)
            text = data[start : start + EXTRA.size]
            entry.fill(text)
            data[start : start + EXTRA.size] = text
            filled[place] = replace(filled[place], data=bytes(data))
        return tuple(filled)


def _entries(records: tuple[Record, ...]) -> Iterator[tuple[int, int, bytes]]:
    """Yield the place of a record, the start of an entry in it, and the entry."""
    for place, record in enumerate(records):
        if is_extra(record):
            for start in range(0, len(record.data) - EXTRA.size + 1, EXTRA.size):
                yield place, start, record.data[start : start + EXTRA.size]


def _entry(place: int, layout: Layout, data: bytes) -> Entry:
    extra = layout.extra[place]
    kind = np.dtype(extra.kind).kind
    no_data = None
    if data[3] & NO_DATA:
        no_data = struct.unpack_from(f"<{extra.count}{WIDE[kind]}", data, PLACES[NO_DATA])
    return Entry(f"extra {place}", kind, extra.count, data[3], no_data)
