"""LAS and LAZ files."""

import io
import struct

import laspy
import lazrs
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.las import chunks
from mops_lightning.data.formats.las.header import read_header
from mops_lightning.data.formats.registry import open_cloud_file, read, write
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents, write_cloud, write_table
from tests.support.clouds import normal_points
from tests.support.copc import write_copc

RECORDS, NUMBER, EVLRS, LONG_NUMBER = 100, 107, 243, 247
"""Places of counts in the header."""

NUMBER_OF_ITEMS, LENGTH_OF_FIRST_ITEM = 32, 36
"""Places in the record that describes the compression."""


def las_cloud(header, number, low=0, high=9):
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = np.random.default_rng(0).uniform(low, high, (3, number))
    return cloud


def test_las_keeps_format_scale_and_dimensions(tmp_path):
    source = tmp_path / "a.las"
    copy = tmp_path / "b.las"
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets = [1000, 1000, 1000]
    header.scales = [0.01, 0.01, 0.01]
    cloud = las_cloud(header, 30, 1000, 1001)
    cloud.intensity = np.arange(30)
    cloud.write(source)

    table = read(source, 100, 0)
    write_table(copy, table.take(np.array([3, 5])))

    again = laspy.read(copy)
    assert again.header.point_format.id == 6
    assert list(again.intensity) == [3, 5]
    assert_array_equal(again.header.scales, [0.01, 0.01, 0.01])


def read_rows(path, chunked, number):
    """Read the first rows of a file by blocks, or the whole file."""
    if chunked:
        open_cloud_file(path).read(range(number))
    else:
        contents(path)


@pytest.mark.parametrize("chunked", [True, False])
def test_las_truncated_between_points_is_broken(chunked, tmp_path):
    path = tmp_path / "a.las"
    points = normal_points(90, 1)
    write_cloud(path, points)
    with laspy.open(path) as file:
        length = file.header.point_format.size
    content = path.read_bytes()
    path.write_bytes(content[: -30 * length])

    with pytest.raises(UserError, match="ends after 60 points"):
        read_rows(path, chunked, 90)


@pytest.mark.parametrize("size", [500, 3000])
def test_laz_damaged_is_broken(size, tmp_path):
    path = tmp_path / "a.laz"
    points = np.random.default_rng(1).uniform(0, 50, size=(3000, 3))
    write_cloud(path, points)
    content = bytearray(path.read_bytes())
    noise = np.random.default_rng(2).integers(0, 256, 900, np.uint8)
    content[600:1500] = bytes(noise)
    path.write_bytes(content)

    with pytest.raises(UserError, match=r"a\.laz is broken"):
        open_cloud_file(path).read(range(size))


def test_las_arrays_and_extended_records_are_kept(tmp_path):
    source = tmp_path / "a.las"
    copy = tmp_path / "b.laz"
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.add_extra_dim(laspy.ExtraBytesParams(name="Colors", type="3u1"))
    header.add_extra_dim(laspy.ExtraBytesParams(name="Height", type="f4"))
    projection = laspy.VLR("LASF_Projection", 2112, "", b"WKT")
    header.evlrs = laspy.vlrs.vlrlist.VLRList([projection])
    cloud = las_cloud(header, 30)
    cloud["Colors"] = np.arange(90).reshape(30, 3)
    cloud["Height"] = np.arange(30)
    cloud.write(source)

    whole = contents(source)
    by_rows = open_cloud_file(source).read(range(30))
    write_table(copy, whole.take(np.array([3, 5])))

    second_colour = list(range(1, 90, 3))
    assert whole.columns["Colors_1"].tolist() == second_colour
    assert by_rows.columns["Colors_1"].tolist() == second_colour
    again = laspy.read(copy)
    assert again["Colors"].tolist() == [[9, 10, 11], [15, 16, 17]]
    assert list(again["Height"]) == [3, 5]
    (record,) = again.evlrs
    assert record.string == "WKT"


def test_las_extra_dimensions_are_read_with_their_scales_and_offsets(tmp_path):
    source = tmp_path / "a.las"
    header = laspy.LasHeader(point_format=6, version="1.4")
    one = {"scales": np.array([0.5]), "offsets": np.array([100.0])}
    two = {"scales": np.array([0.5, 0.25]), "offsets": np.array([100.0, -8.0])}
    header.add_extra_dim(laspy.ExtraBytesParams("depth", "i2", **one))
    header.add_extra_dim(laspy.ExtraBytesParams("pair", "2i2", **two))
    cloud = las_cloud(header, 3)
    cloud["depth"] = np.array([100.5, 101.0, 99.5])
    cloud["pair"] = np.array([[100.5, -7.75], [101.0, -8.0], [99.0, -9.0]])
    cloud.write(source)

    whole = contents(source)
    by_rows = open_cloud_file(source).read(range(3))

    for table in (whole, by_rows):
        assert table.columns["depth"].tolist() == [100.5, 101.0, 99.5]
        assert table.columns["pair_0"].tolist() == [100.5, 101.0, 99.0]
        assert table.columns["pair_1"].tolist() == [-7.75, -8.0, -9.0]


def test_copc_is_written_to_las_without_its_index(scan, tmp_path):
    write(tmp_path / "a.las", contents(scan))

    again = laspy.read(tmp_path / "a.las")
    assert len(again.points) == 30_000
    assert not [*again.header.vlrs, *again.evlrs]


def written(path, form):
    header = laspy.LasHeader(point_format=form, version="1.4" if form > 5 else "1.2")
    header.scales = [0.001] * 3
    las_cloud(header, 300).write(path)
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
        contents(path)
    with pytest.raises(UserError, match=said):
        open_cloud_file(path).read(range(301))


@pytest.mark.parametrize("chunked", [True, False])
def test_laz_of_64_gigabytes_of_chunks_is_broken(chunked, tmp_path):
    path = tmp_path / "a.laz"
    content = written(path, 3)
    (start,) = struct.unpack_from("<I", content, 96)
    (chunk_table,) = struct.unpack_from("<q", content, start)
    struct.pack_into("<I", content, chunk_table + 4, 2**32 - 1)
    path.write_bytes(content)

    with pytest.raises(UserError, match=r"a\.laz is broken.*4,294,967,295 chunks"):
        read_rows(path, chunked, 9)


@pytest.mark.parametrize("form", [0, 1, 2, 3, 6, 7, 8])
def test_laz_with_extra_bytes_reads(form, tmp_path):
    path = tmp_path / "a.laz"
    header = laspy.LasHeader(point_format=form, version="1.4")
    header.add_extra_dim(laspy.ExtraBytesParams("depth", "f4"))
    cloud = las_cloud(header, 300)
    cloud["depth"] = np.arange(300)
    cloud.write(path)
    assert_array_equal(contents(path).columns["depth"], np.arange(300))


def write_scan(path, number):
    unit = np.random.default_rng(0).uniform(0, 100, (number, 3))
    points = unit * [1, 1, 0.1] + [5e5, 4e6, 0]
    write_copc(path, points, spacing=8.0)
    return path


@pytest.fixture
def scan(tmp_path):
    """A COPC file of four levels; cells have up to 300 points, but for the deepest."""
    return write_scan(tmp_path / "scan.copc.laz", 30_000)


def rows_of(table):
    return set(table.columns["intensity"].astype(int))


@pytest.mark.parametrize(
    "bounds",
    [
        "500010,4000020,500030,4000050",
        "5e5,4e6,5,500050,4000090,9",
    ],
)
def test_area_by_bounds_equals_all_points_clipped(bounds, scan, tmp_path):
    plain = tmp_path / "plain.las"
    area = Area.parse(bounds, None, None)
    assert area is not None
    whole = contents(scan)
    write(plain, whole)
    above_low = whole.points >= area.low
    below_high = whole.points <= area.high
    inside = (above_low & below_high).all(1)
    expected = rows_of(whole.take(np.flatnonzero(inside)))

    for path in (scan, plain):
        assert rows_of(read(path, 9, 0, area)) == expected
        file = open_cloud_file(path, area)
        found = []
        for rows in file.row_ranges(700):
            found.extend(rows_of(file.read(rows)))
        assert len(found) == len(expected)
        assert set(found) == expected


@pytest.mark.parametrize(
    ("level", "resolution", "depth"),
    [
        (0, None, 0),
        (2, None, 2),
        (None, 4.1, 1),
        (None, 0.1, 9),
    ],
)
def test_area_by_level_reads_the_levels_above(level, resolution, depth, scan):
    area = Area.parse(None, level, resolution)
    levels = range(depth + 1)
    with laspy.CopcReader.open(scan) as reader:
        expected = set(reader.query(level=levels).intensity)

    table = read(scan, 9, 0, area)

    assert rows_of(table) == expected


def test_one_percent_of_copc_reads_less_than_a_tenth(tmp_path, monkeypatch):
    scan, total = write_scan(tmp_path / "large.copc.laz", 150_000), 0

    class Counted(io.FileIO):
        def readinto(self, buffer):
            nonlocal total
            number = super().readinto(buffer)
            total += number
            return number

    def opened(path, mode="r", *_, **__):
        return io.BufferedReader(Counted(path, mode.strip("b")))

    monkeypatch.setattr("builtins.open", opened)
    monkeypatch.setattr("io.open", opened)
    monkeypatch.setattr("mops_lightning.data.formats.las.isolated", lambda do, *rest: do(*rest))
    table = read(scan, 9, 0, Area(level=1))
    assert len(table.points) > 1500  # 1 %
    assert 0 < total < 0.1 * scan.stat().st_size


def test_copc_damaged_is_broken(scan):
    content = bytearray(scan.read_bytes())
    content[-8:-4] = struct.pack("<i", -7)  # the length of the last cell
    scan.write_bytes(content)
    with pytest.raises(UserError, match=r"scan\.copc\.laz is broken"):
        read(scan, 9, 0, Area.parse("0,0,1e9,1e9", None, None))


def test_box_outside_of_las_or_file_without_levels_says_so(scan, tmp_path):
    elsewhere = Area.parse("0,0,9,9", None, None)
    with pytest.raises(UserError, match=r"scan\.copc\.laz are in 500000\.\d+,4000000"):
        read(scan, 9, 0, elsewhere)

    for suffix in (".las", ".npy", ".xyz"):
        path = tmp_path / f"a{suffix}"
        write_cloud(path, np.eye(3))
        with pytest.raises(UserError, match="need a COPC file"):
            read(path, 9, 0, Area(level=1))


def joined_points(tables):
    return np.concatenate([table.points for table in tables])


def joined_intensities(tables):
    return np.concatenate([table.columns["intensity"] for table in tables])


@pytest.mark.parametrize("form", [3, 6])
@pytest.mark.parametrize("sizes", [[70, 300, 1, 29], [400]])
def test_laz_with_chunks_of_any_size_is_read_by_rows(form, sizes, tmp_path):
    path = tmp_path / "a.laz"
    write_variable_chunks(path, form, sizes)
    whole = laspy.read(path)

    file = open_cloud_file(path)
    tables = [
        file.read(range(0, 50)),
        file.read(range(50, 90)),
        file.read(range(90, 371)),
        file.read(range(371, 400)),
    ]

    assert_array_equal(joined_intensities(tables), np.arange(400))
    assert_array_equal(joined_points(tables), whole.xyz)


@pytest.mark.parametrize(
    "rows",
    [
        range(0, 400),
        range(3, 5),
        range(250, 400),
        range(370, 371),
    ],
)
def test_large_chunk_is_decompressed_in_steps(rows, tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, "LARGEST", 80)
    monkeypatch.setattr(chunks, "STEP", 17)
    path = tmp_path / "a.laz"
    write_variable_chunks(path, 6, [70, 300, 30])
    header = read_header(path)

    found = chunks.read_rows(path, header, rows)

    record = laspy.PointFormat(6).dtype()
    intensities = found.view(record)["intensity"]
    assert intensities.tolist() == list(rows)


def write_variable_chunks(path, form, sizes):
    """Write a LAZ file whose chunks have the given numbers of points, and rows as intensities."""
    number = sum(sizes)
    header = laspy.LasHeader(point_format=form, version="1.4")
    record = laspy.ScaleAwarePointRecord.zeros(number, header=header)
    coordinates = np.random.default_rng(0).random((3, number)) * 9
    record.x, record.y, record.z = coordinates
    record.intensity = np.arange(number)
    header.update(record)
    header.are_points_compressed = True
    laz = lazrs.LazVlr.new_for_compression(form, 0, True)
    header.vlrs.append(laspy.vlrs.known.LasZipVlr(laz.record_data()))
    with path.open("wb") as stream:
        header.write_to(stream)
        compressor = lazrs.LasZipCompressor(stream, laz)
        start = 0
        for size in sizes:
            points = record.array[start : start + size]
            compressor.compress_many(np.frombuffer(points.tobytes(), np.uint8))
            compressor.finish_current_chunk()
            start += size
        compressor.done()


def test_copc_by_blocks_of_rows_equals_whole_file(scan):
    whole = laspy.read(scan)
    file = open_cloud_file(scan)

    tables = [file.read(rows) for rows in file.row_ranges(700)]

    assert_array_equal(joined_points(tables), whole.xyz)
    assert_array_equal(joined_intensities(tables), whole.intensity)


def test_real_copc_file_is_read_by_blocks(real_data):
    path = real_data("airborne") / "lone-star.copc.laz"
    whole = laspy.read(path)
    file = open_cloud_file(path)

    tables = [file.read(rows) for rows in file.row_ranges(100_000)]

    assert_array_equal(joined_points(tables), whole.xyz)


@pytest.mark.parametrize(
    ("name", "length"),
    [
        ("a.laz", 65535 + 8 + 6),  # the first item, the GPS time and the colour
        ("a.copc.laz", 65535 + 6),
    ],
)
def test_laz_with_compressed_points_of_another_length_is_broken(name, length, tmp_path):
    path = tmp_path / name
    points = np.random.default_rng(1).uniform(size=(90, 3))
    write(path, Table(points))
    content = bytearray(path.read_bytes())
    record = content.index(read_header(path).compression)
    struct.pack_into("<H", content, record + LENGTH_OF_FIRST_ITEM, 65535)
    path.write_bytes(content)
    message = f"the record of its compression has points of {length} bytes"

    with pytest.raises(UserError, match=message):
        contents(path)
    with pytest.raises(UserError, match=message):
        open_cloud_file(path).read(range(9))


def test_laz_with_fewer_items_than_announced_is_broken(tmp_path):
    path = tmp_path / "a.laz"
    write(path, Table(np.random.default_rng(1).uniform(size=(90, 3))))
    content = bytearray(path.read_bytes())
    record = content.index(read_header(path).compression)
    struct.pack_into("<H", content, record + NUMBER_OF_ITEMS, 999)
    path.write_bytes(content)

    with pytest.raises(UserError, match="compression is too short for 999 items"):
        contents(path)
