"""The elements of a PLY file: its header, and rows of numbers and lists in ascii or binary."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

KINDS = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
"""Data types by the names of a header."""

BYTE_ORDERS = {
    "binary_little_endian": "<",
    "binary_big_endian": ">",
    "ascii": "<",
}

LONGEST_HEADER = 1 << 20
"""Most bytes of a header; a file that exceeds it is not PLY."""


@dataclass(frozen=True)
class Property:
    """A property of an element.

    Attributes:
        name: of the property.
        kind: data type of a number, with its byte order.
        count: data type of the number of items of a list; None: one number.
    """

    name: str
    kind: np.dtype[Any]
    count: np.dtype[Any] | None = None


@dataclass(frozen=True)
class Element:
    """An element: so many rows of properties."""

    name: str
    number: int
    properties: list[Property] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        """Whether rows may differ in length."""
        return any(part.count is not None for part in self.properties)

    def row_type(self) -> np.dtype[Any]:
        """Return the data type of a row of an element without lists."""
        fields = [(part.name, part.kind) for part in self.properties]
        return np.dtype(fields)


@dataclass(frozen=True)
class Header:
    """The header of a PLY file.

    Attributes:
        is_ascii: whether the numbers are text.
        elements: in the order of the file.
        end: where the header ends, in bytes.
    """

    is_ascii: bool
    elements: list[Element]
    end: int


@dataclass(frozen=True)
class Lists:
    """Lists of different lengths.

    Attributes:
        counts: ``(N,)`` number of items of every list.
        items: items of all lists, one list after the other.
    """

    counts: NDArray[np.int64]
    items: NDArray[Any]

    def by_length(self) -> Iterator[tuple[NDArray[np.int64], NDArray[Any]]]:
        """Yield for every length the rows ``(n,)`` of its lists, and their items ``(n, k)``."""
        starts = np.cumsum(self.counts) - self.counts
        for length in np.unique(self.counts):
            rows = np.flatnonzero(self.counts == length)
            places = starts[rows, None] + np.arange(length)
            yield rows, self.items[places]


Values = NDArray[Any] | Lists


def read_header(data: bytes) -> Header:
    """Parse a header.

    Args:
        data: the first bytes of a file, at least ``LONGEST_HEADER`` if it has as many.

    Raises:
        ValueError: the header is not complete.
    """
    lines, end = _split(data)
    if not lines or lines[0] != ["ply"]:
        raise ValueError("it does not begin with ply")
    form = []
    if len(lines) > 1:
        form = lines[1]
    is_format = len(form) >= 2 and form[0] == "format"
    if not is_format or form[1] not in BYTE_ORDERS:
        raise ValueError("its header says no known format")
    order = BYTE_ORDERS[form[1]]
    elements: list[Element] = []
    for line in lines[2:]:
        if line[0] == "element" and len(line) == 3:
            number = int(line[2])
            if number < 0:
                raise ValueError(f"element {line[1]} has {number} rows")
            elements.append(Element(line[1], number))
        elif line[0] == "property" and elements:
            part = _property(line[1:], order)
            elements[-1].properties.append(part)
        else:
            text = " ".join(line)
            raise ValueError(f"its header has the line {text[:80]!r}")
    is_ascii = form[1] == "ascii"
    return Header(is_ascii, elements, end)


def _split(data: bytes) -> tuple[list[list[str]], int]:
    """Return the words of a header's lines, without comments, and where it ends in bytes."""
    first = re.match(rb"[^\r\n]*(\r?\n|\r)", data)
    newline = b"\n"
    if first and first[1] == b"\r":
        newline = b"\r"
    end_header = re.compile(newline + rb"[ \t]*end_header[ \t\r]*?" + newline)
    last = end_header.search(data, 0, LONGEST_HEADER)
    if not last:
        raise ValueError("its header does not end")
    text = data[: last.start()].decode("latin-1")
    lines = []
    for line in text.split(newline.decode()):
        words = line.split()
        if words and words[0] not in ("comment", "obj_info"):
            lines.append(words)
    return lines, last.end()


def _property(words: list[str], order: str) -> Property:
    is_number = len(words) == 2 and words[0] in KINDS
    if is_number:
        kind = KINDS[words[0]]
        return Property(words[1], np.dtype(order + kind))
    is_list = len(words) == 4 and words[0] == "list" and words[2] in KINDS
    if is_list:
        count = KINDS.get(words[1], "")
        if count.startswith(("i", "u")):
            kind = KINDS[words[2]]
            return Property(words[3], np.dtype(order + kind), np.dtype(order + count))
    text = " ".join(words)
    raise ValueError(f"its header has the property {text[:80]!r}")


def read_elements(data: bytes, header: Header) -> dict[str, dict[str, Values]]:
    """Return the properties of all elements: numbers ``(N,)``, or lists.

    Raises:
        ValueError: the file ends before its last row.
    """
    if header.is_ascii:
        words = data[header.end :].split()
        return _ascii_elements(words, header.elements)
    found = {}
    offset = header.end
    for element in header.elements:
        found[element.name], offset = _binary_element(data, offset, element)
    return found


def _ends_early(element: Element, number: int) -> ValueError:
    wanted = f"{element.number} rows of {element.name}"
    return ValueError(f"its header says {wanted}, it has {number}")


def _binary_element(data: bytes, offset: int, element: Element) -> tuple[dict[str, Values], int]:
    """Return the properties of an element, and where it ends."""
    if not element.properties or not element.number:
        return {}, offset
    if element.has_lists:
        return _element_with_lists(data, offset, element)
    kind = element.row_type()
    available = (len(data) - offset) // kind.itemsize
    if available < element.number:
        raise _ends_early(element, available)
    rows = np.frombuffer(data, kind, element.number, offset)
    values: dict[str, Values] = {name: rows[name] for name in kind.names or ()}
    return values, offset + rows.nbytes


def _element_with_lists(
    data: bytes, offset: int, element: Element
) -> tuple[dict[str, Values], int]:
    lengths = _lengths_in_row(data, offset, element)
    kind = _row_type_of_lengths(element, lengths)
    if len(data) - offset >= kind.itemsize * element.number:
        rows = np.frombuffer(data, kind, element.number, offset)
        if _all_have_lengths(rows, lengths):
            return _of_equal_lengths(rows, element), offset + rows.nbytes
    return _walk(data, offset, element)


def _all_have_lengths(rows: NDArray[Any], lengths: Mapping[int, int]) -> bool:
    """Return whether the lists of all rows have the lengths of the first row."""
    for number, length in lengths.items():
        is_same = rows[f"count {number}"] == length
        if not is_same.all():
            return False
    return True


def _lengths_in_row(data: bytes, offset: int, element: Element) -> dict[int, int]:
    """Return the number of items of every list in one row, by the number of the property."""
    lengths = {}
    for number, part in enumerate(element.properties):
        if part.count is None:
            offset += part.kind.itemsize
            continue
        lengths[number] = _count(data, offset, part, element)
        offset += part.count.itemsize
        offset += lengths[number] * part.kind.itemsize
    return lengths


class _Collected:
    """The bytes of one property, from rows of different lengths.

    Args:
        part: the property.
    """

    def __init__(self, part: Property) -> None:
        self.part = part
        self.size = part.kind.itemsize
        self.count_size = 0
        self.byte_order: Literal["big", "little"] = "little"
        self.is_signed = False
        if part.count is not None:
            self.count_size = part.count.itemsize
            self.is_signed = part.count.kind == "i"
            if part.count.byteorder == ">":
                self.byte_order = "big"
        self.pieces: list[bytes] = []
        self.counts: list[int] = []

    def values(self) -> Values:
        """Return the numbers of all rows, or the lists."""
        data = b"".join(self.pieces)
        items = np.frombuffer(data, self.part.kind)
        if self.part.count is None:
            return items
        return Lists(np.array(self.counts, np.int64), items)


def _count(data: bytes, offset: int, part: Property, element: Element) -> int:
    assert part.count is not None
    if offset + part.count.itemsize > len(data):
        raise _ends_early(element, 0)
    count = int(np.frombuffer(data, part.count, 1, offset)[0])
    size = count * part.kind.itemsize
    if not 0 <= size <= len(data) - offset:
        raise ValueError(f"a list of {part.name} has {count} items")
    return count


def _row_type_of_lengths(element: Element, lengths: Mapping[int, int]) -> np.dtype[Any]:
    fields: list[Any] = []
    for place, part in enumerate(element.properties):
        if part.count is None:
            fields.append((f"item {place}", part.kind))
        else:
            fields.append((f"count {place}", part.count))
            shape = (lengths[place],)
            fields.append((f"item {place}", part.kind, shape))
    return np.dtype(fields)


def _of_equal_lengths(rows: NDArray[Any], element: Element) -> dict[str, Values]:
    values: dict[str, Values] = {}
    for place, part in enumerate(element.properties):
        items = rows[f"item {place}"]
        if part.count is None:
            values[part.name] = items
        else:
            counts = rows[f"count {place}"].astype(np.int64)
            values[part.name] = Lists(counts, items.reshape(-1))
    return values


def _walk(data: bytes, offset: int, element: Element) -> tuple[dict[str, Values], int]:
    """Read rows of different lengths, one after the other."""
    columns = [_Collected(part) for part in element.properties]
    for row in range(element.number):
        for column in columns:
            number = 1
            if column.count_size:
                word = data[offset : offset + column.count_size]
                number = int.from_bytes(word, column.byte_order, signed=column.is_signed)
                column.counts.append(number)
                offset += column.count_size
            end = offset + number * column.size
            if number < 0 or end > len(data):
                raise _ends_early(element, row)
            column.pieces.append(data[offset:end])
            offset = end
    values = {column.part.name: column.values() for column in columns}
    return values, offset


def _ascii_elements(words: list[bytes], elements: list[Element]) -> dict[str, dict[str, Values]]:
    properties: dict[str, dict[str, Values]] = {}
    start = 0
    for element in elements:
        if not element.properties or not element.number:
            properties[element.name] = {}
        elif element.has_lists:
            properties[element.name], start = _ascii_lists(words, start, element)
        else:
            properties[element.name], start = _ascii_numbers(words, start, element)
    return properties


def _ascii_numbers(
    words: list[bytes], start: int, element: Element
) -> tuple[dict[str, Values], int]:
    """Return the numbers of an element without lists, and the first word after it."""
    width = len(element.properties)
    end = start + width * element.number
    if end > len(words):
        raise _ends_early(element, (len(words) - start) // width)
    numbers = np.array(words[start:end], np.float64)
    rows = numbers.reshape(-1, width)
    values: dict[str, Values] = {}
    for column, part in zip(rows.T, element.properties, strict=True):
        values[part.name] = _of_kind(column, part)
    return values, end


def _ascii_lists(words: list[bytes], start: int, element: Element) -> tuple[dict[str, Values], int]:
    items: list[list[bytes]] = [[] for _ in element.properties]
    counts: list[list[int]] = [[] for _ in element.properties]
    for row in range(element.number):
        for column, part in enumerate(element.properties):
            number = 1
            if part.count is not None:
                if start >= len(words):
                    raise _ends_early(element, row)
                number = int(words[start])
                counts[column].append(number)
                start += 1
            end = start + number
            if number < 0 or end > len(words):
                raise _ends_early(element, row)
            items[column] += words[start:end]
            start = end
    values: dict[str, Values] = {}
    for column, part in enumerate(element.properties):
        exact = np.array(items[column], np.float64)
        numbers = _of_kind(exact, part)
        if part.count is None:
            values[part.name] = numbers
        else:
            lengths = np.array(counts[column], np.int64)
            values[part.name] = Lists(lengths, numbers)
    return values, start


def _of_kind(numbers: NDArray[np.float64], part: Property) -> NDArray[Any]:
    """Return numbers of an ascii file in the data type that its header says.

    Raises:
        ValueError: the data type does not hold a number.
    """
    if part.kind.kind == "f":
        return numbers.astype(part.kind)
    kept = numbers.astype(part.kind)
    if not np.array_equal(kept, numbers):
        raise ValueError(f"{part.name} has numbers that are no {part.kind}")
    return kept
