"""The elements of a PLY file: its header, and rows of numbers and lists in ascii or binary."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip

BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}

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
        return np.dtype([(part.name, part.kind) for part in self.properties])


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
            yield rows, self.items[starts[rows][:, None] + np.arange(length)]


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
    form = lines[1] if len(lines) > 1 else []
    if len(form) < 2 or form[0] != "format" or form[1] not in BYTE_ORDERS:
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
            elements[-1].properties.append(_property(line[1:], order))
        else:
            raise ValueError(f"its header has the line {' '.join(line)[:80]!r}")
    return Header(form[1] == "ascii", elements, end)


def _split(data: bytes) -> tuple[list[list[str]], int]:
    """Return the words of a header's lines, without comments, and where it ends in bytes."""
    first = re.match(rb"[^\r\n]*(\r?\n|\r)", data)
    end = b"\r" if first and first[1] == b"\r" else b"\n"
    last = re.compile(end + rb"[ \t]*end_header[ \t\r]*?" + end).search(data, 0, LONGEST_HEADER)
    if not last:
        raise ValueError("its header does not end")
    text = data[: last.start()].decode("latin-1")
    words = [line.split() for line in text.split(end.decode())]
    return [line for line in words if line[:1] not in ([], ["comment"], ["obj_info"])], last.end()


def _property(words: list[str], order: str) -> Property:
    if len(words) == 2 and words[0] in KINDS:
        return Property(words[1], np.dtype(order + KINDS[words[0]]))
    is_list = len(words) == 4 and words[0] == "list"
    if is_list and words[1] in KINDS and words[2] in KINDS and KINDS[words[1]][0] != "f":
        kind, count = np.dtype(order + KINDS[words[2]]), np.dtype(order + KINDS[words[1]])
        return Property(words[3], kind, count)
    raise ValueError(f"its header has the property {' '.join(words)[:80]!r}")


def read_elements(data: bytes, header: Header) -> dict[str, dict[str, Values]]:
    """Return the properties of all elements: numbers ``(N,)``, or lists.

    Raises:
        ValueError: the file ends before its last row.
    """
    if header.is_ascii:
        return _ascii_elements(data[header.end :].split(), header.elements)
    found = {}
    offset = header.end
    for element in header.elements:
        found[element.name], offset = _binary_element(data, offset, element)
    return found


def _ends_early(element: Element, number: int) -> ValueError:
    return ValueError(f"its header says {element.number} rows of {element.name}, it has {number}")


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
    return {name: rows[name] for name in kind.names or ()}, offset + rows.nbytes


def _element_with_lists(
    data: bytes, offset: int, element: Element
) -> tuple[dict[str, Values], int]:
    lengths = _lengths_in_row(data, offset, element)
    kind = _row_type_of_lengths(element, lengths)
    if len(data) - offset >= kind.itemsize * element.number:
        rows = np.frombuffer(data, kind, element.number, offset)
        same = all(
            bool((rows[f"count {place}"] == length).all()) for place, length in lengths.items()
        )
        if same:
            return _of_equal_lengths(rows, element), offset + rows.nbytes
    return _walk(data, offset, element)


def _lengths_in_row(data: bytes, offset: int, element: Element) -> dict[int, int]:
    """Return the number of items of every list in one row, by the place of the property."""
    lengths = {}
    for place, part in enumerate(element.properties):
        if part.count is None:
            offset += part.kind.itemsize
            continue
        lengths[place] = _count(data, offset, part, element)
        offset += part.count.itemsize + lengths[place] * part.kind.itemsize
    return lengths


def _count(data: bytes, offset: int, part: Property, element: Element) -> int:
    assert part.count is not None
    if offset + part.count.itemsize > len(data):
        raise _ends_early(element, 0)
    count = int(np.frombuffer(data, part.count, 1, offset)[0])
    if not 0 <= count * part.kind.itemsize <= len(data) - offset:
        raise ValueError(f"a list of {part.name} has {count} items")
    return count


def _row_type_of_lengths(element: Element, lengths: Mapping[int, int]) -> np.dtype[Any]:
    fields: list[Any] = []
    for place, part in enumerate(element.properties):
        if part.count is None:
            fields.append((f"item {place}", part.kind))
        else:
            fields.append((f"count {place}", part.count))
            fields.append((f"item {place}", part.kind, (lengths[place],)))
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
    parts = element.properties
    pieces: list[list[bytes]] = [[] for _ in parts]
    counts: list[list[int]] = [[] for _ in parts]
    steps = [
        (place, part.kind.itemsize, part.count.itemsize if part.count is not None else 0)
        for place, part in enumerate(parts)
    ]
    orders = [
        "big" if part.count is not None and part.count.byteorder == ">" else "little"
        for part in parts
    ]
    signed = [part.count is not None and part.count.kind == "i" for part in parts]
    for row in range(element.number):
        for place, size, count_size in steps:
            number = 1
            if count_size:
                word = data[offset : offset + count_size]
                number = int.from_bytes(word, orders[place], signed=signed[place])  # type: ignore[arg-type]
                counts[place].append(number)
                offset += count_size
            end = offset + number * size
            if number < 0 or end > len(data):
                raise _ends_early(element, row)
            pieces[place].append(data[offset:end])
            offset = end
    values: dict[str, Values] = {}
    for place, part in enumerate(parts):
        items = np.frombuffer(b"".join(pieces[place]), part.kind)
        is_list = part.count is not None
        values[part.name] = Lists(np.array(counts[place], np.int64), items) if is_list else items
    return values, offset


def _ascii_elements(words: list[bytes], elements: list[Element]) -> dict[str, dict[str, Values]]:
    found: dict[str, dict[str, Values]] = {}
    place = 0
    for element in elements:
        found[element.name] = {}
        if not element.properties or not element.number:
            continue
        if element.has_lists:
            found[element.name], place = _ascii_lists(words, place, element)
            continue
        width = len(element.properties)
        end = place + width * element.number
        if end > len(words):
            raise _ends_early(element, (len(words) - place) // width)
        numbers = np.array(words[place:end], np.float64).reshape(-1, width)
        for column, part in zip(numbers.T, element.properties, strict=True):
            found[element.name][part.name] = _of_kind(column, part)
        place = end
    return found


def _ascii_lists(words: list[bytes], place: int, element: Element) -> tuple[dict[str, Values], int]:
    items: list[list[bytes]] = [[] for _ in element.properties]
    counts: list[list[int]] = [[] for _ in element.properties]
    for row in range(element.number):
        for column, part in enumerate(element.properties):
            number = 1
            if part.count is not None:
                if place >= len(words):
                    raise _ends_early(element, row)
                number = int(words[place])
                counts[column].append(number)
                place += 1
            end = place + number
            if number < 0 or end > len(words):
                raise _ends_early(element, row)
            items[column] += words[place:end]
            place = end
    values: dict[str, Values] = {}
    for column, part in enumerate(element.properties):
        numbers = _of_kind(np.array(items[column], np.float64), part)
        is_list = part.count is not None
        values[part.name] = (
            Lists(np.array(counts[column], np.int64), numbers) if is_list else numbers
        )
    return values, place


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
