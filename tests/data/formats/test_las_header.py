"""Counts and offsets of LAS files, compared with the length of the file."""

import struct

import laspy
import numpy as np
import pytest

from mops_lightning.data.formats.registry import open_cloud_file, read
from mops_lightning.errors import UserError

VLRS, RECORD_LENGTH, NUMBER, EVLRS, LONG_NUMBER = 100, 105, 107, 243, 247
"""Places of counts in the header."""


def written(path, form, number=300):
    cloud = laspy.LasData(laspy.LasHeader(point_format=form, version="1.4" if form > 5 else "1.2"))
    cloud.header.scales = [0.001] * 3
    cloud.x, cloud.y, cloud.z = np.random.default_rng(0).uniform(0, 9, (3, number))
    cloud.write(path)
    return bytearray(path.read_bytes())


@pytest.mark.parametrize(
    ("name", "form", "place", "kind", "value", "said"),
    [
        ("a.las", 3, VLRS, "<I", 2**32 - 1, "4294967295 variable length records"),
        ("a.las", 6, EVLRS, "<I", 2**32 - 1, "4294967295 extended variable length records"),
        ("a.las", 3, NUMBER, "<I", 2**32 - 1, "ends after 300 points"),
        ("a.las", 6, LONG_NUMBER, "<Q", 2**63, "ends after 300 points"),
        ("a.las", 3, 96, "<I", 2**32 - 1, "the point data"),
        ("a.las", 3, RECORD_LENGTH, "<H", 0, "no bytes"),
        ("a.laz", 3, VLRS, "<I", 2**32 - 1, "4294967295 variable length records"),
        ("a.laz", 3, NUMBER, "<I", 2**32 - 1, "chunks cannot hold 4294967295 points"),
        ("a.laz", 6, LONG_NUMBER, "<Q", 2**40, "chunks cannot hold 1099511627776 points"),
    ],
)
@pytest.mark.parametrize("reader", [lambda path: read(path, 9, 0), open_cloud_file])
def test_las_impossible_count_is_broken(reader, name, form, place, kind, value, said, tmp_path):
    path = tmp_path / name
    content = written(path, form)
    struct.pack_into(kind, content, place, value)
    path.write_bytes(content)
    with pytest.raises(UserError, match=said):
        reader(path)


@pytest.mark.parametrize(
    ("form", "place", "kind", "value", "said"),
    [
        (3, 0, "<q", 2**40, "the chunk table"),
        (3, 0, "<q", 5, "the chunk table"),
        (6, 8 + 30 + 4, "<I", 2**32 - 1, "a chunk's layers"),
    ],
)
def test_laz_impossible_offset_is_broken(form, place, kind, value, said, tmp_path):
    path = tmp_path / "a.laz"
    content = written(path, form)
    struct.pack_into(kind, content, struct.unpack_from("<I", content, 96)[0] + place, value)
    path.write_bytes(content)
    with pytest.raises(UserError, match=said):
        read(path, 9, 0)


def test_laz_impossible_number_of_chunks_is_broken(tmp_path):
    path = tmp_path / "a.laz"
    content = written(path, 3)
    start = struct.unpack_from("<I", content, 96)[0]
    struct.pack_into("<I", content, struct.unpack_from("<q", content, start)[0] + 4, 2**32 - 1)
    path.write_bytes(content)
    with pytest.raises(UserError, match="4294967295 chunks"):
        read(path, 9, 0)


@pytest.mark.parametrize("form", [0, 1, 2, 3, 6, 7, 8])
def test_laz_with_extra_bytes_reads(form, tmp_path):
    path = tmp_path / "a.laz"
    header = laspy.LasHeader(point_format=form, version="1.4")
    header.add_extra_dim(laspy.ExtraBytesParams("depth", "f4"))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = np.random.default_rng(0).uniform(0, 9, (3, 300))
    cloud["depth"] = np.arange(300)
    cloud.write(path)
    np.testing.assert_array_equal(read(path, 9, 0).columns["depth"], np.arange(300))


def test_laz_without_items_is_broken(tmp_path):
    path = tmp_path / "a.laz"
    content = written(path, 3)
    struct.pack_into("<H", content, content.index(b"laszip encoded") - 2 + 54 + 32, 0)
    path.write_bytes(content)
    with pytest.raises(UserError, match="points of 34 bytes, items of 0 bytes"):
        read(path, 9, 0)
