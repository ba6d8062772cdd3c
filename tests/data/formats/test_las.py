"""LAS and LAZ files."""

import struct

import laspy
import numpy as np
import pytest

from mops_lightning.data.formats.registry import WRITERS, open_cloud_file, read
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError

RECORDS, NUMBER, EVLRS, LONG_NUMBER = 100, 107, 243, 247
"""Places of counts in the header."""


def test_las_keeps_format_scale_and_dimensions(tmp_path):
    cloud = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    cloud.header.offsets, cloud.header.scales = [1000] * 3, [0.01] * 3
    cloud.x, cloud.y, cloud.z = np.random.default_rng(0).uniform(1000, 1001, (3, 30))
    cloud.intensity = np.arange(30)
    cloud.write(tmp_path / "a.las")
    table = read(tmp_path / "a.las", 100, 0)
    WRITERS[".las"](tmp_path / "b.las", table.take(np.array([3, 5])))
    again = laspy.read(tmp_path / "b.las")
    assert again.header.point_format.id == 6
    assert list(again.intensity) == [3, 5]
    np.testing.assert_array_equal(again.header.scales, [0.01] * 3)


@pytest.mark.parametrize("chunked", [True, False])
def test_las_truncated_between_points_is_broken(chunked, tmp_path):
    path = tmp_path / "a.las"
    points = np.random.default_rng(1).normal(size=(90, 3))
    WRITERS[".las"](path, Table(points))
    with laspy.open(path) as file:
        length = file.header.point_format.size
    path.write_bytes(path.read_bytes()[: -30 * length])
    with pytest.raises(UserError, match="ends after 60 points"):
        open_cloud_file(path).read(range(90)) if chunked else read(path, 9, 0)


@pytest.mark.parametrize("size", [500, 3000])
def test_laz_damaged_is_broken(size, tmp_path):
    path = tmp_path / "a.laz"
    WRITERS[".laz"](path, Table(np.random.default_rng(1).uniform(0, 50, size=(3000, 3))))
    content = bytearray(path.read_bytes())
    content[600:1500] = bytes(np.random.default_rng(2).integers(0, 256, 900, np.uint8))
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"a\.laz is broken"):
        open_cloud_file(path).read(range(size))


def test_las_arrays_and_extended_records_are_kept(tmp_path):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.add_extra_dim(laspy.ExtraBytesParams(name="Colors", type="3u1"))
    header.add_extra_dim(laspy.ExtraBytesParams(name="Height", type="f4"))
    header.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("LASF_Projection", 2112, "", b"WKT")])
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = np.random.default_rng(0).uniform(0, 9, (3, 30))
    cloud["Colors"], cloud["Height"] = np.arange(90).reshape(30, 3), np.arange(30)
    cloud.write(tmp_path / "a.las")
    for table in (
        read(tmp_path / "a.las", 9, 0),
        open_cloud_file(tmp_path / "a.las").read(range(30)),
    ):
        assert table.columns["Colors_1"].tolist() == list(range(1, 90, 3))
    table = read(tmp_path / "a.las", 9, 0)
    WRITERS[".laz"](tmp_path / "b.laz", table.take(np.array([3, 5])))
    again = laspy.read(tmp_path / "b.laz")
    assert [list(again[f"Colors_{place}"]) for place in range(3)] == [[9, 15], [10, 16], [11, 17]]
    assert list(again["Height"]) == [3, 5]
    assert "Colors" not in again.point_format.dimension_names
    assert [record.string for record in again.evlrs] == ["WKT"]


def test_copc_is_written_without_its_index(tmp_path):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.vlrs.append(laspy.copc.CopcInfoVlr())
    header.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("copc", 1000, "", b"pages")])
    points = np.random.default_rng(0).uniform(0, 9, (30, 3))
    WRITERS[".las"](tmp_path / "a.las", Table(points, header=header))
    again = laspy.read(tmp_path / "a.las")
    assert len(again.points) == 30
    assert not [*again.header.vlrs, *again.evlrs]


def written(path, form, number=300):
    cloud = laspy.LasData(laspy.LasHeader(point_format=form, version="1.4" if form > 5 else "1.2"))
    cloud.header.scales = [0.001] * 3
    cloud.x, cloud.y, cloud.z = np.random.default_rng(0).uniform(0, 9, (3, number))
    cloud.write(path)
    return bytearray(path.read_bytes())


@pytest.mark.parametrize(
    ("name", "form", "place", "kind", "value", "said"),
    [
        ("a.las", 3, NUMBER, "<I", 301, "ends after 300 points"),
        ("a.las", 6, LONG_NUMBER, "<Q", 2**63, "cannot hold 9,223,372,036,854,775,808 points"),
        ("a.las", 3, RECORDS, "<I", 2**31, "cannot hold 2,147,483,648 records"),
        ("a.laz", 6, RECORDS, "<I", 2**31, "cannot hold 2,147,483,648 records"),
        ("a.las", 6, EVLRS, "<I", 2**32 - 1, "cannot hold 4,294,967,295 records"),
        ("a.laz", 3, NUMBER, "<I", 2**32 - 1, "cannot hold 4,294,967,295 points"),
    ],
)
def test_las_impossible_count_is_broken(name, form, place, kind, value, said, tmp_path):
    path = tmp_path / name
    content = written(path, form)
    struct.pack_into(kind, content, place, value)
    path.write_bytes(content)
    with pytest.raises(UserError, match=said):
        read(path, 9, 0)
    with pytest.raises(UserError, match=said):
        open_cloud_file(path).read(range(301))


@pytest.mark.parametrize("chunked", [True, False])
def test_laz_of_64_gigabytes_of_chunks_is_broken(chunked, tmp_path):
    path = tmp_path / "a.laz"
    content = written(path, 3)
    start = struct.unpack_from("<I", content, 96)[0]
    struct.pack_into("<I", content, struct.unpack_from("<q", content, start)[0] + 4, 2**32 - 1)
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"a\.laz is broken.*died"):
        open_cloud_file(path).read(range(9)) if chunked else read(path, 9, 0)


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
