"""The smallest and largest numbers of extra dimensions, where their record names them."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.las.header import Header, Record
from mops_lightning.data.formats.las.layout import EXTRA, Layout, Rows, is_extra

NO_DATA = 1
SMALLEST = 2
LARGEST = 4
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
        smallest = []
        largest = []
        for element in range(self.count):
            values = self._values(numbers[:, element], element)
            if not len(values):
                return  # one of an array's numbers has no value
            smallest.append(values.min().item())
            largest.append(values.max().item())
        if self.smallest is None or self.largest is None:
            self.smallest = smallest
            self.largest = largest
            return
        lows = zip(self.smallest, smallest, strict=True)
        highs = zip(self.largest, largest, strict=True)
        self.smallest = [min(pair) for pair in lows]
        self.largest = [max(pair) for pair in highs]

    def _values(self, numbers: NDArray[Any], element: int) -> NDArray[Any]:
        """Return the numbers that are values."""
        if self.no_data is not None:
            numbers = numbers[numbers != self.no_data[element]]
        if self.kind == "f":
            numbers = numbers[~np.isnan(numbers)]
        return numbers

    def fill(self, entry: bytearray) -> None:
        """Write the numbers into an entry of the record."""
        if self.smallest is None or self.largest is None:
            return
        if self.options & SMALLEST:
            self._write(entry, PLACES[SMALLEST], self.smallest)
        if self.options & LARGEST:
            self._write(entry, PLACES[LARGEST], self.largest)

    def _write(self, entry: bytearray, start: int, values: list[Any]) -> None:
        form = f"<{self.count}{WIDE[self.kind]}"
        struct.pack_into(form, entry, start, *values)


class ExtraRanges:
    """The numbers of all extra dimensions of a file that is written."""

    def __init__(self, header: Header, layout: Layout) -> None:
        self.entries: dict[tuple[int, int], Entry] = {}
        fields = iter(range(len(layout.extra)))
        for record, start, data in _entries(header.records):
            type_ = data[2]
            options = data[3]
            if type_ == 0 and options == 0:
                continue  # takes no bytes, so that the layout lacks it
            field = next(fields, None)
            if field is None:
                break
            has_range = options & (SMALLEST | LARGEST)
            if type_ and has_range:
                self.entries[record, start] = _entry(field, layout, data)

    def add(self, rows: Rows) -> None:
        """Look at more points."""
        for entry in self.entries.values():
            entry.add(rows)

    def fill(self, records: tuple[Record, ...]) -> tuple[Record, ...]:
        """Return the records of the file with the numbers of its points."""
        filled = list(records)
        for (number, start), entry in self.entries.items():
            record = filled[number]
            data = bytearray(record.data)
            end = start + EXTRA.size
            text = data[start:end]
            entry.fill(text)
            data[start:end] = text
            filled[number] = replace(record, data=bytes(data))
        return tuple(filled)


def _entries(records: tuple[Record, ...]) -> Iterator[tuple[int, int, bytes]]:
    """Yield the number of a record, the start of an entry in it, and the entry."""
    for number, record in enumerate(records):
        if not is_extra(record):
            continue
        last = len(record.data) - EXTRA.size
        for start in range(0, last + 1, EXTRA.size):
            data = record.data[start : start + EXTRA.size]
            yield number, start, data


def _entry(number: int, layout: Layout, data: bytes) -> Entry:
    extra = layout.extra[number]
    kind = np.dtype(extra.kind).kind
    options = data[3]
    no_data = None
    if options & NO_DATA:
        form = f"<{extra.count}{WIDE[kind]}"
        no_data = struct.unpack_from(form, data, PLACES[NO_DATA])
    return Entry(f"extra {number}", kind, extra.count, options, no_data)
