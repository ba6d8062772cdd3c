"""Headers of LAS at the limits of what is allowed, and dimensions of points one by one."""

import struct
from typing import Any

import numpy as np
import pytest

from mops_lightning.data.formats.las.header import Header, Record, read_header
from mops_lightning.data.formats.las.layout import EXTRA, Extra, Layout, free_name, layout_of
from mops_lightning.errors import UserError


def write_head(path, minor, size, form=0, number=0, more=b""):
    """Write a header without records and points."""
    head = bytearray(size)
    head[:4] = b"LASF"
    head[24:26] = bytes([1, minor])
    struct.pack_into("<H", head, 94, size)
    struct.pack_into("<2I", head, 96, size, 0)
    struct.pack_into("<BHI", head, 104, form, 20, number)
    path.write_bytes(bytes(head) + more)
    return path


LEAST = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}
"""Bytes of the headers of LAS 1.0 to 1.5."""


@pytest.mark.parametrize("minor", LEAST)
def test_header_has_as_many_bytes_as_its_version_needs(minor, tmp_path):
    size = LEAST[minor]
    whole = write_head(tmp_path / "whole.las", minor, size)

    assert read_header(whole).minor == minor
    cut = write_head(tmp_path / "cut.las", minor, size - 1)
    with pytest.raises(UserError, match=r"cut\.las is broken: "):
        read_header(cut)


@pytest.mark.parametrize("form", [0, 10, 128 + 10])
def test_points_of_formats_0_to_10_are_known(form, tmp_path):
    header = read_header(write_head(tmp_path / "a.las", 4, 375, form))

    assert header.format == form % 128
    assert header.compressed == (form >= 128)


def test_points_of_format_11_are_refused(tmp_path):
    path = write_head(tmp_path / "a.las", 4, 375, 11)

    with pytest.raises(UserError, match="points of format 11, but formats 0 to 10 are read"):
        read_header(path)


def test_compressed_points_take_a_1024th_of_a_byte_or_more(tmp_path):
    most = 227 * 1024
    path = write_head(tmp_path / "a.laz", 2, 227, 128, most)

    assert read_header(path).number == most
    write_head(path, 2, 227, 128, most + 1)
    with pytest.raises(UserError, match=r"227 bytes cannot hold 232,449 points"):
        read_header(path)


@pytest.mark.parametrize(("place", "inside"), [(0, False), (300, True)])
def test_waveforms_of_version_1_3_are_inside_where_the_header_says_their_place(
    place, inside, tmp_path
):
    path = write_head(tmp_path / "a.las", 3, 235)
    content = bytearray(path.read_bytes())
    struct.pack_into("<Q", content, 227, place)
    path.write_bytes(content)

    assert read_header(path).waveforms_inside == inside


def test_record_is_that_of_its_user_and_number():
    first = Record.new("laszip encoded", 1, b"first")
    second = Record.new("copc", 1, b"second")
    third = Record.new("copc", 2, b"third")
    header = Header(bytes(375), (first, second, third))

    assert header.record("copc", 1) == second
    assert header.record("copc", 2) == third
    assert header.record("laszip encoded", 2) is None
    assert header.copc == second


def test_user_of_a_record_may_have_any_bytes():
    record = Record(b"\0\0", "Büro".encode("latin-1") + b"\0x", 1, b"", b"")

    assert record.user == "Büro"


KINDS: dict[str, tuple[Any, str]] = {
    "truth": (np.bool_, "u1"),
    "half": (np.float16, "<f4"),
    "single": (np.float32, "<f4"),
    "double": (np.float64, "<f8"),
    "extended": (np.longdouble, "<f8"),
    "byte": (np.int8, "i1"),
    "swapped": (">u2", "<u2"),
    "long": (np.int64, "<i8"),
}


@pytest.mark.parametrize("name", KINDS)
def test_column_becomes_an_extra_dimension_of_its_type(name):
    kind, expected = KINDS[name]

    layout, names = Layout(6).with_columns({"new": np.ones(2, kind)})

    assert layout.extra == (Extra("new", expected),)
    assert names == {"new": "new"}


@pytest.mark.parametrize(("number", "is_one"), [(1, False), (2, True), (3, True), (4, False)])
def test_arrays_of_two_or_three_new_columns_are_one_dimension(number, is_one):
    members = tuple(f"v_{place}" for place in range(number))
    columns = {name: np.ones(2, np.float32) for name in members}

    layout, names = Layout(6).with_columns(columns, {"v": members})

    if is_one:
        assert layout.extra == (Extra("v", "<f4", number),)
    else:
        assert layout.extra == tuple(Extra(name, "<f4") for name in members)
    assert names == {name: name for name in members}


def test_array_with_a_member_that_the_points_have_is_written_by_columns():
    columns = {"intensity": np.ones(2, np.uint16), "other": np.ones(2, np.uint16)}

    layout, names = Layout(6).with_columns(columns, {"pair": ("intensity", "other")})

    assert layout.extra == (Extra("other", "<u2"),)
    assert names == {"intensity": "intensity", "other": "other"}


def test_names_have_at_most_32_bytes_and_whole_letters():
    long = "ü" * 20

    assert free_name(long, {}) == "ü" * 16
    assert free_name(long, {"ü" * 16: None}) == "ü" * 15 + "_"
    assert free_name("a", {"a": None, "a_": None}) == "a__"


def test_bits_and_steps_are_written_beside_each_other():
    extra = (Extra("steps", "<i2", 1, (0.5,), (10.0,)), Extra("plain", "<f4"))
    layout = Layout(6, extra)
    rows = np.zeros(3, layout.dtype)
    values = {
        "return_number": np.array([1, 15, 7]),
        "number_of_returns": np.array([15, 2, 8]),
        "steps": np.array([10.3, 9.7, 12.0]),
        "plain": np.array([0.25, 0.5, -1]),
    }

    for name, column in values.items():
        layout.dimensions[name].set(rows, column)
    layout.dimensions["return_number"].set(rows, np.array([2, 4, 8]))

    found = {name: layout.dimensions[name].get(rows).tolist() for name in values}
    assert found == {
        "return_number": [2, 4, 8],
        "number_of_returns": [15, 2, 8],
        "steps": [10.5, 9.5, 12.0],
        "plain": [0.25, 0.5, -1],
    }


def entry(type_, options, name, scales=(0.0,) * 3, offsets=(0.0,) * 3):
    return EXTRA.pack(type_, options, name, *scales, *offsets, b"")


def header_of(item, *entries):
    head = bytearray(375)
    head[25] = 4
    struct.pack_into("<BH", head, 104, 6, item)
    return Header(bytes(head), (Record.new("LASF_Spec", 4, b"".join(entries)),))


def test_every_kind_of_entry_is_read():
    scales = (0.5, 2.0, 4.0)
    offsets = (1.0, -1.0, 3.0)
    header = header_of(
        30 + 2 + 4 + 24 + 5 + 1,
        entry(3, 0, b"number"),
        entry(13, 8, b"pair", scales),
        entry(30, 24, b"triple\xff", scales, offsets),
        entry(0, 5, b"bytes"),
        entry(2, 0, b"last"),
    )

    assert layout_of(header).extra == (
        Extra("number", "<u2"),
        Extra("pair", "<u2", 2, (0.5, 2.0)),
        Extra("triple\ufffd", "<f8", 3, (0.5, 2.0, 4.0), (1.0, -1.0, 3.0)),
        Extra("bytes", "u1", 5, documented=False),
        Extra("last", "<i1"),
    )


def test_entries_of_more_bytes_than_a_point_has_are_not_believed():
    header = header_of(30 + 3, entry(3, 0, b"number"), entry(3, 0, b"more"))

    assert layout_of(header).extra == (Extra("ExtraBytes", "u1", 3, documented=False),)


def test_undocumented_bytes_are_documented_in_pieces_of_seven():
    pieces = list(Extra("bytes", "u1", 16, documented=False).pieces())

    assert [(piece.name, piece.count) for piece in pieces] == [
        ("bytes", 7),
        ("bytes_7", 7),
        ("bytes_14", 2),
    ]
    (whole,) = Extra("number", "<u2").pieces()
    assert whole.to_bytes()[2:4] == bytes([3, 0])
    assert pieces[2].to_bytes()[2:4] == bytes([0, 2])
