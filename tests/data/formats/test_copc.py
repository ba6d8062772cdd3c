"""COPC files that are written, read by laspy and copclib."""

import sys

import copclib
import laspy
import numpy as np
import pytest

from mops_lightning.data.formats.area import Area
from mops_lightning.data.formats.las import octree
from mops_lightning.data.formats.registry import open_cloud_file, read, write
from mops_lightning.data.formats.table import Table, TableParts
from mops_lightning.errors import UserError
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


@pytest.mark.parametrize("form", [6, 7, 8])
def test_copc_keeps_all_bytes_of_points_and_header(form, small_cells, tmp_path):
    source, out = tmp_path / "a.las", tmp_path / "out.copc.laz"
    cloud = full_cloud(form, 5000)
    cloud.write(source)

    write(out, read(source, 1, 0))

    np.testing.assert_array_equal(in_order(all_points(out).array), in_order(cloud.points.array))
    before, after = header_fields(source), header_fields(out)
    info, pages = after["records"].pop(0), after["extended"].pop(0)
    assert (info[0][:4], info[1], len(info[3])) == (b"copc", 1, 160)
    assert (pages[0][:4], pages[1], len(pages[3]) % 32) == (b"copc", 1000, 0)
    assert before == after
    assert not list(tmp_path.glob(".mops*"))


def test_copclib_finds_every_point_in_its_cell(small_cells, tmp_path):
    out = tmp_path / "out.copc.laz"
    cloud = full_cloud(7, 5000)
    cloud.write(tmp_path / "a.las")

    write(out, read(tmp_path / "a.las", 1, 0))

    file = copclib.FileReader(str(out))
    nodes = file.GetAllNodes()
    assert len(nodes) > 20
    assert max(node.key.d for node in nodes) >= 2
    assert file.ValidateSpatialBounds()
    points = [point for node in nodes for point in file.GetPoints(node)]
    found = sorted((p.x, p.y, p.z, p.gps_time, p.classification, p.red) for p in points)
    columns = [cloud.xyz.T, cloud.gps_time, cloud.classification, cloud.red]
    assert found == sorted(map(tuple, np.vstack(columns).T.tolist()))
    with laspy.CopcReader.open(out) as reader:
        times = reader.copc_info.gps_min, reader.copc_info.gps_max
    assert times == (cloud.gps_time.min(), cloud.gps_time.max())


def test_levels_are_even_samples(small_cells, tmp_path):
    out = tmp_path / "out.copc.laz"
    plane = np.random.default_rng(0).uniform(0, 100, (9000, 3)) * [1, 1, 0.01]
    dense = plane[:3000] * 0.2

    write(out, Table(np.vstack([plane, dense])))

    for level, side in ((0, 8), (1, 16)):
        points = read(out, 1, 0, Area(level=level)).points
        with laspy.CopcReader.open(out) as reader:
            low, length = reader.header.mins, 2 * reader.copc_info.halfsize
        cubes = np.floor((points - low) / length * side).clip(0, side - 1)
        occupied = len(np.unique(cubes, axis=0))
        assert occupied >= 0.9 * side**2
        assert len(points) <= 1.4 * side**2


def test_area_of_a_written_file_equals_the_points_in_it(small_cells, tmp_path):
    out = tmp_path / "out.copc.laz"
    points = np.random.default_rng(1).uniform(0, 100, (4000, 3)) + np.array([1e6, 5e6, 0])
    write(out, Table(points, {"row": np.arange(4000, dtype=np.uint16)}))
    area = Area((1000010, 5000020, -1), (1000030, 5000080, 101))

    found = read(out, 1, 0, area).columns["row"]

    written = read(out, 1, 0)
    inside = ((written.points >= area.low) & (written.points <= area.high)).all(1)
    assert sorted(found) == sorted(written.columns["row"][inside])
    assert len(found) > 100


def test_parts_in_any_order_and_size_give_the_same_cells(small_cells, tmp_path):
    source = tmp_path / "a.laz"
    full_cloud(6, 4000).write(source)
    file = open_cloud_file(source)
    for name, size in (("one", 4000), ("two", 70)):
        tables = [file.read(rows) for rows in file.row_ranges(size)]
        whole = read(source, 1, 0)
        corners = np.stack([whole.points.min(0), whole.points.max(0)])
        parts = TableParts(iter(tables), 4000, corners, np.dtype("f8"), {}, file.header)
        write(tmp_path / f"{name}.copc.laz", parts)

    one, two = ((tmp_path / f"{name}.copc.laz").read_bytes() for name in ("one", "two"))
    assert one == two


@pytest.mark.parametrize("number", [1, 3])
def test_copies_of_one_point_are_a_file(number, small_cells, tmp_path):
    write(tmp_path / "a.copc.laz", Table(np.full((number, 3), 7.5)))

    assert np.asarray(all_points(tmp_path / "a.copc.laz").x).tolist() == [7.5] * number


def test_more_equal_points_than_a_cell_holds_are_kept(small_cells, tmp_path):
    points = np.repeat([[0.0, 0, 0], [1, 1, 1]], 900, axis=0)
    write(tmp_path / "a.copc.laz", Table(points))

    found = all_points(tmp_path / "a.copc.laz")
    assert np.unique(np.asarray(found.x), return_counts=True)[1].tolist() == [900, 900]


@pytest.mark.parametrize("form", [0, 1, 2, 3])
def test_older_formats_keep_their_dimensions_in_copc(form, tmp_path):
    cloud = full_cloud(form)
    cloud.write(tmp_path / "a.laz")

    write(tmp_path / "out.copc.laz", read(tmp_path / "a.laz", 1, 0))

    found = all_points(tmp_path / "out.copc.laz")
    found = found[np.argsort(np.asarray(found.point_source_id))]
    assert found.point_format.id == (7 if form > 1 else 6)
    for name in cloud.point_format.dimension_names:
        if name != "scan_angle_rank":
            np.testing.assert_array_equal(np.asarray(found[name]), np.asarray(cloud[name]), name)
    angles = np.asarray(found.scan_angle) * 0.006
    np.testing.assert_allclose(angles, cloud.scan_angle_rank, atol=0.003)
    names = [extra.name for extra in found.point_format.extra_dimensions]
    assert names == [extra.name for extra in EXTRA]


def test_geotiff_keys_are_converted(tmp_path):
    pytest.importorskip("pyproj", reason="pyproj converts coordinate systems; it is no dependency")
    from pyproj import CRS

    cloud = full_cloud(3)
    cloud.header.vlrs = [r for r in cloud.header.vlrs if r.record_id != 2112]
    cloud.header.add_crs(CRS.from_epsg(25832))
    cloud.write(tmp_path / "a.laz")

    write(tmp_path / "out.copc.laz", read(tmp_path / "a.laz", 1, 0))

    with laspy.CopcReader.open(tmp_path / "out.copc.laz") as reader:
        assert reader.header.parse_crs() == CRS.from_epsg(25832)
        assert reader.header.global_encoding.wkt


def test_geotiff_keys_need_pyproj(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    cloud = full_cloud(3)
    keys = np.array([1, 1, 0, 1, 3072, 0, 1, 25832], "<u2").tobytes()
    cloud.header.vlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("LASF_Projection", 34735, "", keys)])
    cloud.write(tmp_path / "a.laz")

    with pytest.raises(UserError, match=r"in WKT, but IN has it in GeoTIFF keys. Install pyproj"):
        write(tmp_path / "out.copc.laz", read(tmp_path / "a.laz", 1, 0))


def test_real_files_become_copc_with_all_points(real_data, tmp_path):
    for name in ("autzen_trim_7.las", "las_with_several_extra_byte_bloc.laz"):
        source = real_data("airborne") / name
        write(tmp_path / "out.copc.laz", read(source, 1, 0))

        found, cloud = all_points(tmp_path / "out.copc.laz"), laspy.read(source)
        names = ("X", "Y", "Z", "gps_time", "point_source_id")
        found, expected = (in_order(p, names) for p in (found.array, cloud.points.array))
        for dimension in cloud.point_format.standard_dimension_names:
            if dimension in found.dtype.names:
                np.testing.assert_array_equal(found[dimension], expected[dimension])
        assert copclib.FileReader(str(tmp_path / "out.copc.laz")).ValidateSpatialBounds()
