"""The dimensions of a point in a LAS file, and reading and writing them in packed points."""

import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.las.header import EXTRA_BYTES, SPEC, Header, Record

Rows = NDArray[np.void]
"""Packed points, of a ``Layout``'s data type."""

EXTRA = struct.Struct("<2xBB32s4x72x3d3d32s")
"""An extra dimension in the record: type, options, name, scales, offsets, description."""

TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
"""Types 1 to 10 of extra dimensions; 11 to 20 are pairs of them, 21 to 30 triples."""

SCALED = 8
SHIFTED = 16
"""Bits of an extra dimension's options."""

PIECE = 7
"""Most undocumented bytes in an entry."""

NAME_BYTES = 32
"""Most bytes of the name of an extra dimension."""


@dataclass(frozen=True)
class Extra:
    """An extra dimension.

    Attributes:
        name: as in the file.
        kind: type of a number, such as ``<u2``.
        count: how many numbers it has per point.
        scales: of each number, or None.
        offsets: of each number, or None.
        documented: whether the file says what its bytes mean.
    """

    name: str
    kind: str
    count: int = 1
    scales: tuple[float, ...] | None = None
    offsets: tuple[float, ...] | None = None
    documented: bool = True

    @property
    def size(self) -> int:
        """Number of bytes."""
        return np.dtype(self.kind).itemsize * self.count

    def pieces(self) -> "Iterator[Extra]":
        """Yield undocumented bytes in pieces that laspy 2.7 reads.

        It takes bits 8 and 16 of their number for those of a scale and an offset.
        """
        if self.documented:
            yield self
            return
        for start in range(0, self.count, PIECE):
            name = self.name if start == 0 else f"{self.name}_{start}"
            yield replace(self, name=name, count=min(PIECE, self.count - start))

    def to_bytes(self) -> bytes:
        """Return the entry of a dimension without scales, or of undocumented bytes."""
        type_ = 0
        options = self.count
        if self.documented:
            kind = TYPES.index(self.kind.lstrip("<|"))
            type_ = 1 + kind + len(TYPES) * (self.count - 1)
            options = 0
        scales_and_offsets = (0.0,) * 6
        return EXTRA.pack(type_, options, self.name.encode(), *scales_and_offsets, b"")


@dataclass(frozen=True)
class Dimension:
    """Where a column is in packed points.

    Attributes:
        field: of the data type.
        mask: bits of a field; 0: all.
        element: of an array.
        scale: value of a step.
        offset: value of the number 0.
    """

    field: str
    mask: int = 0
    element: int | None = None
    scale: float | None = None
    offset: float | None = None

    @property
    def is_scaled(self) -> bool:
        """Whether the values are not the numbers in the file."""
        return self.scale is not None or self.offset is not None

    @property
    def _shift(self) -> int:
        return (self.mask & -self.mask).bit_length() - 1

    def _numbers(self, rows: Rows) -> NDArray[Any]:
        numbers = rows[self.field]
        if self.element is None:
            return numbers
        return numbers[:, self.element]

    @property
    def _step(self) -> float:
        if self.scale is None:
            return 1.0
        return self.scale

    @property
    def _start(self) -> float:
        if self.offset is None:
            return 0.0
        return self.offset

    def get(self, rows: Rows) -> NDArray[Any]:
        """Return the values ``(N,)``."""
        numbers = self._numbers(rows)
        if self.mask:
            return (numbers & self.mask) >> self._shift
        if not self.is_scaled:
            return numbers.copy()
        return numbers * self._step + self._start

    def set(self, rows: Rows, values: NDArray[Any]) -> None:
        """Write values ``(N,)``, which the dimension can hold."""
        numbers = self._numbers(rows)
        if self.mask:
            bits = (values.astype(numbers.dtype) << self._shift) & self.mask
            others = numbers & ~np.uint8(self.mask)
            numbers[:] = others | bits
        elif self.is_scaled:
            steps = (values - self._start) / self._step
            if numbers.dtype.kind in "iu":
                steps = np.rint(steps)
            numbers[:] = steps
        else:
            numbers[:] = values


@dataclass(frozen=True)
class Layout:
    """The dimensions of a file's points.

    Attributes:
        format: 0 to 10.
        extra: the extra dimensions.
    """

    format: int
    extra: tuple[Extra, ...] = ()

    @cached_property
    def standard(self) -> np.dtype[Any]:
        """The data type of a point without extra dimensions."""
        import laspy

        kind: np.dtype[Any] = laspy.PointFormat(self.format).dtype()
        return kind

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """The data type of a point."""
        kinds: list[Any] = []
        for name in self.standard.names or ():
            kinds.append((name, self.standard[name]))
        for number, extra in enumerate(self.extra):
            shape: tuple[int, ...] = ()
            if extra.count > 1:
                shape = (extra.count,)
            kinds.append((f"extra {number}", extra.kind, shape))
        return np.dtype(kinds)

    @cached_property
    def dimensions(self) -> dict[str, Dimension]:
        """Where every column is; an array of k numbers is k columns, ``NAME_0`` to ``NAME_k-1``."""
        dimensions = self._standard_dimensions()
        for number, extra in enumerate(self.extra):
            field = f"extra {number}"
            if extra.count == 1:
                name = free_name(extra.name, dimensions)
                dimensions[name] = _extra_dimension(field, extra, None)
                continue
            for element in range(extra.count):
                name = free_name(f"{extra.name}_{element}", dimensions)
                dimensions[name] = _extra_dimension(field, extra, element)
        return dimensions

    def _standard_dimensions(self) -> dict[str, Dimension]:
        import laspy

        bits = laspy.point.dims.get_sub_fields_dict(self.format)
        dimensions: dict[str, Dimension] = {}
        for name in laspy.PointFormat(self.format).dimension_names:
            if name in bits:
                field, sub_field = bits[name]
                dimensions[name] = Dimension(field, sub_field.mask)
            elif name not in "XYZ":
                dimensions[name] = Dimension(name)
        return dimensions

    @property
    def arrays(self) -> dict[str, tuple[str, ...]]:
        """The names of the arrays, and the columns of each."""
        columns_of: dict[str, list[str]] = {}
        for name, dimension in self.dimensions.items():
            if dimension.element is not None:
                number = int(dimension.field.removeprefix("extra "))
                array = self.extra[number].name
                columns_of.setdefault(array, []).append(name)
        return {name: tuple(columns) for name, columns in columns_of.items()}

    def holds(self, name: str, values: NDArray[Any]) -> bool:
        """Return whether a dimension holds values ``(any,)`` exactly."""
        dimension = self.dimensions[name]
        rows = np.zeros(len(values), self.dtype)
        is_float = values.dtype.kind == "f"
        with suppress(OverflowError, TypeError, ValueError), np.errstate(all="ignore"):
            dimension.set(rows, values)
            return np.array_equal(dimension.get(rows), values, equal_nan=is_float)
        return False

    def with_columns(
        self,
        columns: Mapping[str, NDArray[Any]],
        arrays: Mapping[str, tuple[str, ...]] | None = None,
    ) -> tuple["Layout", dict[str, str]]:
        """Add dimensions for columns that the layout lacks, or cannot hold exactly.

        Args:
            columns: numbers of every column ``(any,)``.
            arrays: names of arrays, and the columns of each; those of two or three become one
                dimension.

        Returns:
            The layout, and the dimension of every column.
        """
        names: dict[str, str] = {}
        for name, values in columns.items():
            if name in self.dimensions and self.holds(name, values):
                names[name] = name
        array_of = self._new_arrays(columns, arrays or {})
        columns_of: dict[str, tuple[str, ...]] = {}
        taken = dict.fromkeys(self.dimensions)
        extra = list(self.extra)
        placed = set(names)
        for name, values in columns.items():
            if name in placed:
                continue
            wanted, together = array_of.get(name, (name, (name,)))
            free = free_name(wanted, taken)
            taken[free] = None
            columns_of[f"extra {len(extra)}"] = together
            extra.append(Extra(free, _kind(values), len(together)))
            placed.update(together)
        layout = Layout(self.format, tuple(extra))
        for dimension_name, dimension in layout.dimensions.items():
            if dimension.field in columns_of:
                column = columns_of[dimension.field][dimension.element or 0]
                names[column] = dimension_name
        return layout, names

    def _new_arrays(
        self, columns: Mapping[str, NDArray[Any]], arrays: Mapping[str, tuple[str, ...]]
    ) -> dict[str, tuple[str, tuple[str, ...]]]:
        """Return the array of every column that can be one dimension with its neighbours."""
        array_of: dict[str, tuple[str, tuple[str, ...]]] = {}
        for name, members in arrays.items():
            kinds = [columns[member].dtype for member in members if member in columns]
            is_whole = len(kinds) == len(members) and len(set(kinds)) == 1
            is_new = self.dimensions.keys().isdisjoint(members)
            if is_whole and is_new and len(members) in (2, 3):
                array_of |= dict.fromkeys(members, (name, members))
        return array_of


def _extra_dimension(field: str, extra: Extra, element: int | None) -> Dimension:
    """Return an extra dimension, or one element of an array."""
    place = element or 0
    return Dimension(
        field,
        element=element,
        scale=None if extra.scales is None else extra.scales[place],
        offset=None if extra.offsets is None else extra.offsets[place],
    )


def free_name(name: str, taken: Mapping[str, Any]) -> str:
    """Return a name of at most 32 bytes that is not taken."""
    tail = ""
    while True:
        room = NAME_BYTES - len(tail)
        free = name.encode()[:room].decode(errors="ignore") + tail
        if free not in taken:
            return free
        tail += "_"


def _kind(values: NDArray[Any]) -> str:
    """Return the type of an extra dimension for values: truth values are u1, float16 float32."""
    kind = values.dtype.newbyteorder("<")
    if kind.kind == "b":
        return "u1"
    if kind.kind == "f" and kind.itemsize not in (4, 8):
        if kind.itemsize == 2:
            return "<f4"
        return "<f8"
    return kind.str.replace("|", "")


def layout_of(header: Header) -> Layout:
    """Return the dimensions of a file's points, undocumented extra bytes as an array.

    Raises:
        ValueError: a point has fewer bytes than its format needs.
    """
    left = header.item - Layout(header.format).standard.itemsize
    if left < 0:
        raise ValueError(f"a point of format {header.format} does not fit in {header.item} bytes")
    extra = documented_extra(header)
    left -= _size(extra)
    if left:
        extra.append(Extra("ExtraBytes", "u1", left, documented=False))
    return Layout(header.format, tuple(extra))


def _size(extra: list[Extra]) -> int:
    return sum(dimension.size for dimension in extra)


def is_extra(record: Record) -> bool:
    """Return whether a record documents extra dimensions, of which a file may have several."""
    return (record.user, record.number) == (SPEC, EXTRA_BYTES)


def documented_extra(header: Header) -> list[Extra]:
    """Return the extra dimensions that a header documents.

    Where it documents more bytes than a point has, the record is invalid by the specification.
    """
    room = header.item - Layout(header.format).standard.itemsize
    extra: list[Extra] = []
    for record in header.records:
        if is_extra(record):
            extra += _documented(record.data)
    if _size(extra) > room:
        return []
    return extra


def _documented(data: bytes) -> Iterator[Extra]:
    """Yield the extra dimensions that a record documents, up to one of an unknown type."""
    for start in range(0, len(data) - EXTRA.size + 1, EXTRA.size):
        type_, options, name, *numbers, _ = EXTRA.unpack_from(data, start)
        if type_ > 3 * len(TYPES):
            return
        text = name.split(b"\0")[0].decode(errors="replace")
        if type_ == 0:
            extra = Extra(text, "u1", options, documented=False)
        else:
            extra = _numbers_entry(text, type_, options, numbers)
        if extra.size:
            yield extra


def _numbers_entry(name: str, type_: int, options: int, numbers: list[float]) -> Extra:
    """Return an extra dimension of numbers; ``numbers`` are three scales and three offsets."""
    more, kind = divmod(type_ - 1, len(TYPES))
    count = 1 + more
    scales = None
    if options & SCALED:
        scales = tuple(numbers[:count])
    offsets = None
    if options & SHIFTED:
        offsets = tuple(numbers[3 : 3 + count])
    return Extra(name, f"<{TYPES[kind]}", count, scales, offsets)
