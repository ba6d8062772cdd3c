"""COPC files that are written, read by laspy and copclib."""

import sys

import copclib
import laspy
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.las import octree
from mops_lightning.data.formats.registry import open_cloud_file, read, write
from mops_lightning.data.formats.table import Table, TableParts
from mops_lightning.errors import UserError
from tests.support.clouds import uniform_points
from tests.support.las import EXTRA, full_cloud, header_fields


@pytest.fixture
def small_cells(monkeypatch):
    """Cells of few points, most of which wait in temporary files."""
    monkeypatch.setattr(octree, "LEAF", 200)
    monkeypatch.setattr(octree, "GRID", 8)
    monkeypatch.setattr(octree, "MEMORY", 1500)
    monkeypatch.setattr(octree, "PART", 333)


def all_points(path):
    with laspy.CopcReader.open(path) as reader:
        return reader.query()


def in_order(array, names=("X", "Y", "Z", "point_source_id")):
    return array[np.lexsort([array[name] for name in names])]


def joined_header(path):
    """Return the fields of a header, without the two records that only COPC files have."""
    fields = header_fields(path)
    info = fields["records"].pop(0)
    pages = fields["extended"].pop(0)
    return fields, info, pages


@pytest.mark.parametrize("form", [6, 7, 8])
def test_copc_keeps_all_bytes_of_points_and_header(form, small_cells, tmp_path):
    source = tmp_path / "a.las"
    out = tmp_path / "out.copc.laz"
    cloud = full_cloud(form, 5000)
    cloud.write(source)

    write(out, read(source, 1, 0))

    written = all_points(out).array
    assert_array_equal(in_order(written), in_order(cloud.points.array))
    header, info, pages = joined_header(out)
    assert header == header_fields(source)
    info_user, info_id, _, info_data = info
    assert info_user[:4] == b"copc"
    assert info_id == 1
    assert len(info_data) == 160
    pages_user, pages_id, _, pages_data = pages
    assert pages_user[:4] == b"copc"
    assert pages_id == 1000
    assert len(pages_data) % 32 == 0
    assert not list(tmp_path.glob(".mops*"))


def test_copclib_finds_every_point_in_its_cell(small_cells, tmp_path):
    source = tmp_path / "a.las"
    out = tmp_path / "out.copc.laz"
    cloud = full_cloud(7, 5000)
    cloud.write(source)

    write(out, read(source, 1, 0))

    file = copclib.FileReader(str(out))
    nodes = file.GetAllNodes()
    assert len(nodes) > 20
    assert max(node.key.d for node in nodes) >= 2
    assert file.ValidateSpatialBounds()
    names = ["x", "y", "z", "gps_time", "classification", "red"]
    found = []
    for node in nodes:
        for point in file.GetPoints(node):
            found.append([getattr(point, name) for name in names])
    columns = [cloud[name] for name in names]
    expected = np.stack(columns, axis=1).tolist()
    assert sorted(found) == sorted(expected)
    with laspy.CopcReader.open(out) as reader:
        info = reader.copc_info
    assert info.gps_min == cloud.gps_time.min()
    assert info.gps_max == cloud.gps_time.max()


def test_levels_are_even_samples(small_cells, tmp_path):
    out = tmp_path / "out.copc.laz"
    plane = uniform_points(9000, 0) * [100, 100, 1]
    dense = plane[:3000] * 0.2
    points = np.vstack([plane, dense])

    write(out, Table(points))

    with laspy.CopcReader.open(out) as reader:
        low = reader.header.mins
        length = 2 * reader.copc_info.halfsize
    for level, side in ((0, 8), (1, 16)):
        points = read(out, 1, 0, Area(level=level)).points
        scaled = (points - low) / length * side
        cubes = np.floor(scaled).clip(0, side - 1)
        occupied = len(np.unique(cubes, axis=0))
        assert occupied >= 0.9 * side**2
        assert len(points) <= 1.4 * side**2


def test_root_keeps_the_points_nearest_to_the_centres_of_its_cubes(small_cells, tmp_path):
    """Eight cubes along each side; four points of a level plane are in each."""
    out = tmp_path / "out.copc.laz"
    corners = np.indices((8, 8)).reshape(2, 64).T
    in_cube = [(0.5, 0.5), (0.05, 0.05), (0.9, 0.9), (0.1, 0.8)]
    of_cubes = [corners + place for place in in_cube]
    ends = np.array([[0.0, 0.0], [8.0, 8.0]])
    plane = np.concatenate([*of_cubes, ends])
    heights = np.zeros(len(plane))

    write(out, Table(np.column_stack([plane, heights])))

    root = read(out, 1, 0, Area(level=0)).points
    places = root[:, :2].round(6).tolist()
    assert sorted(places) == (corners + 0.5).tolist()


@pytest.mark.parametrize(
    ("share_of_side", "level"),
    [
        (1.01 / 128, 0),
        (0.99 / 128, 1),
    ],
)
def test_resolution_is_compared_with_one_128th_of_the_side(
    small_cells, tmp_path, share_of_side, level
):
    out = tmp_path / "out.copc.laz"
    points = 100 * uniform_points(4000, 0)
    write(out, Table(points))
    with laspy.CopcReader.open(out) as reader:
        side = 2 * reader.copc_info.halfsize
    resolution = share_of_side * side

    found = read(out, 1, 0, Area(resolution=resolution)).points

    of_level = read(out, 1, 0, Area(level=level)).points
    assert len(found) == len(of_level)
    assert len(found) < len(points)


def test_area_of_a_written_file_equals_the_points_in_it(small_cells, tmp_path):
    out = tmp_path / "out.copc.laz"
    unit = uniform_points(4000, 1)
    points = 100 * unit + np.array([1e6, 5e6, 0])
    row = np.arange(4000, dtype=np.uint16)
    write(out, Table(points, {"row": row}))
    low = (1000010, 5000020, -1)
    high = (1000030, 5000080, 101)
    area = Area(low, high)

    found = read(out, 1, 0, area).columns["row"]

    written = read(out, 1, 0)
    above_low = (written.points >= area.low).all(1)
    below_high = (written.points <= area.high).all(1)
    expected = written.columns["row"][above_low & below_high]
    assert sorted(found) == sorted(expected)
    assert len(found) > 100


def write_by_parts(path, source, size):
    """Write the points of a file as COPC, read in parts of a number of points."""
    whole = read(source, 1, 0)
    low = whole.points.min(0)
    high = whole.points.max(0)
    corners = np.stack([low, high])
    file = open_cloud_file(source)
    tables = (file.read(rows) for rows in file.row_ranges(size))
    parts = TableParts(tables, 4000, corners, np.dtype("f8"), {}, file.header)
    write(path, parts)


def test_parts_in_any_order_and_size_give_the_same_cells(small_cells, tmp_path):
    source = tmp_path / "a.laz"
    full_cloud(6, 4000).write(source)
    in_one = tmp_path / "one.copc.laz"
    in_many = tmp_path / "many.copc.laz"

    write_by_parts(in_one, source, 4000)
    write_by_parts(in_many, source, 70)

    assert in_one.read_bytes() == in_many.read_bytes()


@pytest.mark.parametrize("number", [1, 3])
def test_copies_of_one_point_are_a_file(number, small_cells, tmp_path):
    out = tmp_path / "a.copc.laz"
    points = np.full((number, 3), 7.5)

    write(out, Table(points))

    found = np.asarray(all_points(out).x)
    assert found.tolist() == [7.5] * number


def test_more_equal_points_than_a_cell_holds_are_kept(small_cells, tmp_path):
    out = tmp_path / "a.copc.laz"
    zeros = np.zeros((900, 3))
    ones = np.ones((900, 3))
    points = np.vstack([zeros, ones])

    write(out, Table(points))

    found = np.asarray(all_points(out).x)
    assert (found == 0).sum() == 900
    assert (found == 1).sum() == 900


@pytest.mark.parametrize("form", [0, 1, 2, 3])
def test_older_formats_keep_their_dimensions_in_copc(form, tmp_path):
    source = tmp_path / "a.laz"
    out = tmp_path / "out.copc.laz"
    cloud = full_cloud(form)
    cloud.write(source)

    write(out, read(source, 1, 0))

    found = all_points(out)
    order = np.argsort(np.asarray(found.point_source_id))
    found = found[order]
    assert found.point_format.id == (7 if form > 1 else 6)
    for name in cloud.point_format.dimension_names:
        if name != "scan_angle_rank":
            values = np.asarray(found[name])
            assert_array_equal(values, np.asarray(cloud[name]), name)
    angles = np.asarray(found.scan_angle) * 0.006
    assert_allclose(angles, cloud.scan_angle_rank, atol=0.003)
    names = [extra.name for extra in found.point_format.extra_dimensions]
    assert names == [extra.name for extra in EXTRA]


def test_geotiff_keys_are_converted(tmp_path):
    pytest.importorskip("pyproj", reason="pyproj converts coordinate systems; it is no dependency")
    from pyproj import CRS

    source = tmp_path / "a.laz"
    out = tmp_path / "out.copc.laz"
    utm = CRS.from_epsg(25832)
    cloud = full_cloud(3)
    without_wkt = [record for record in cloud.header.vlrs if record.record_id != 2112]
    cloud.header.vlrs = without_wkt
    cloud.header.add_crs(utm)
    cloud.write(source)

    write(out, read(source, 1, 0))

    with laspy.CopcReader.open(out) as reader:
        assert reader.header.parse_crs() == utm
        assert reader.header.global_encoding.wkt


@pytest.mark.parametrize("form", [1, 3, 6, 7])
def test_copc_says_that_a_coordinate_system_is_in_wkt_as_new_formats_require(form, tmp_path):
    source = tmp_path / "a.las"
    out = tmp_path / "out.copc.laz"
    cloud = full_cloud(form)
    cloud.header.global_encoding.wkt = False
    cloud.write(source)

    write(out, read(source, 1, 0))

    before = laspy.read(source).header.global_encoding
    with laspy.CopcReader.open(out) as reader:
        after = reader.header.global_encoding
    assert not before.wkt
    assert after.wkt
    assert after.gps_time_type == before.gps_time_type


def test_geotiff_keys_need_pyproj(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    source = tmp_path / "a.laz"
    one_key = [1, 1, 0, 1]
    projection = [3072, 0, 1, 25832]
    keys = np.array([*one_key, *projection], "<u2")
    record = laspy.VLR("LASF_Projection", 34735, "", keys.tobytes())
    cloud = full_cloud(3)
    cloud.header.vlrs = laspy.vlrs.vlrlist.VLRList([record])
    cloud.write(source)
    table = read(source, 1, 0)

    with pytest.raises(UserError, match=r"in WKT, but IN has it in GeoTIFF keys. Install pyproj"):
        write(tmp_path / "out.copc.laz", table)


def test_real_files_become_copc_with_all_points(real_data, tmp_path):
    order = ("X", "Y", "Z", "gps_time", "point_source_id")
    out = tmp_path / "out.copc.laz"
    for name in ("autzen_trim_7.las", "las_with_several_extra_byte_bloc.laz"):
        source = real_data("airborne") / name

        write(out, read(source, 1, 0))

        cloud = laspy.read(source)
        expected = in_order(cloud.points.array, order)
        found = in_order(all_points(out).array, order)
        for dimension in cloud.point_format.standard_dimension_names:
            if dimension in found.dtype.names:
                assert_array_equal(found[dimension], expected[dimension])
        assert copclib.FileReader(str(out)).ValidateSpatialBounds()
