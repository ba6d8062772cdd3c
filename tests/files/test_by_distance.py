"""Spacing and voxels of files: whole, in chunks, by Dask, in folders, with attributes and maps."""

import struct
from typing import Any

import laspy
import numpy as np
import pytest

from mops_lightning.data.formats.registry import WRITERS, read
from mops_lightning.data.formats.table import Table
from mops_lightning.files import by_distance
from mops_lightning.ops.spacing import keep_spaced
from tests.support.downsample import done, refused

RNG = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def short_ranges(monkeypatch):
    """Read the small files of these tests in several ranges."""
    monkeypatch.setattr(by_distance, "LEAST_CHUNK", 1)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """A scan in map coordinates of six digits, with copies, ties and points that are not finite."""
    path = tmp_path_factory.mktemp("scan") / "scan.ply"
    points = RNG.uniform(0, 4, (900, 3)) + np.array([512_345.25, 5_412_345.5, 100.0])
    points[100:200] = points[:100]
    points[200:400] = np.round(points[200:400] * 2) / 2
    points[500] = np.nan
    normals = RNG.normal(size=(900, 3))
    columns: dict[str, Any] = {
        "row": np.arange(900, dtype=np.int32),
        "red": RNG.integers(0, 256, 900).astype(np.uint8),
        "heat": RNG.normal(size=900) * 1e9,
        "nx": normals[:, 0],
        "ny": normals[:, 1],
        "nz": normals[:, 2],
    }
    WRITERS[".ply"](path, Table(points, columns))
    return path


BUDGETS = {
    "spacing": ["--spacing", 0.7],
    "spacing weighted": ["--spacing", 0.7, "--weight", "red"],
    "spacing in space": ["--spacing", 0.7, "--space", "z=2,red=0.01"],
    "voxel": ["--voxel", 0.8],
    "voxel weighted": ["--voxel", 0.8, "--weight", "red"],
    "voxel means": ["--voxel", 0.8, "--readout", "generated"],
    "spacing in bounds": ["--spacing", 0.7, "--bounds", "512345,5412345,512348,5412348"],
    "voxel in bounds": ["--voxel", 0.8, "--bounds", "512345,5412345,512348,5412348"],
}


@pytest.mark.parametrize("budget", BUDGETS)
def test_chunks_and_tiles_equal_one_pass(budget, scan, tmp_path):
    done(scan, tmp_path / "whole.npz", *BUDGETS[budget])
    whole = read(tmp_path / "whole.npz", 9, 0)

    for name, options in {
        "1000": ["--chunk", 1000],
        "250": ["--chunk", 250],
        "31": ["--chunk", 31],
        "tile": ["--tile", 64],
    }.items():
        done(scan, tmp_path / f"{name}.npz", *BUDGETS[budget], *options)
        part = read(tmp_path / f"{name}.npz", 9, 0)
        np.testing.assert_array_equal(part.points, whole.points)
        assert part.columns.keys() == whole.columns.keys()
        for column, values in whole.columns.items():
            np.testing.assert_array_equal(part.columns[column], values)


def test_spacing_keeps_rows_of_the_op(scan, tmp_path):
    out = done(scan, tmp_path / "out.npz", "--spacing", 0.7)

    kept, whole = read(tmp_path / "out.npz", 9, 0), read(scan, 9, 0).finite()
    rows = keep_spaced(whole.points, 0.7)
    np.testing.assert_array_equal(kept.points, whole.points[rows])
    np.testing.assert_array_equal(kept.columns["row"], whole.columns["row"][rows])
    assert f"{len(rows)} of 899 points (1 more without finite coordinates left out)" in out


def test_voxel_keeps_one_row_of_each_and_prints_the_origin(scan, tmp_path):
    out = done(scan, tmp_path / "out.npz", "--voxel", 0.8)

    kept, whole = read(tmp_path / "out.npz", 9, 0), read(scan, 9, 0)
    places = np.unique(np.floor(whole.finite().points / 0.8), axis=0)
    assert len(kept.points) == len(places)
    np.testing.assert_array_equal(kept.points, whole.points[kept.columns["row"]])
    assert "voxels of 0.8 from the origin 0 0 0" in out


def test_voxel_means_average_quantities_and_renormalise_normals(scan, tmp_path):
    done(scan, tmp_path / "out.npz", "--voxel", 0.8, "--readout", "generated")

    means, whole = read(tmp_path / "out.npz", 9, 0), read(scan, 9, 0).finite()
    places, voxel = np.unique(np.floor(whole.points / 0.8), axis=0, return_inverse=True)
    counts = np.bincount(voxel)
    for axis in range(3):
        expected = np.bincount(voxel, whole.points[:, axis]) / counts
        np.testing.assert_allclose(means.points[:, axis], expected, rtol=0, atol=2e-8)
    heat = np.bincount(voxel, whole.columns["heat"]) / counts
    np.testing.assert_allclose(means.columns["heat"], heat, rtol=1e-9, atol=1e-3)
    red = np.bincount(voxel, whole.columns["red"]) / counts
    np.testing.assert_allclose(means.columns["red"], red, atol=0.5)
    normals = np.stack([means.columns[name] for name in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    rows = means.columns["row"]
    assert (voxel[np.searchsorted(whole.columns["row"], rows)] == np.arange(len(places))).all()


@pytest.mark.parametrize("chunk", [[], ["--chunk", 2]])
def test_voxel_mean_of_a_missing_value_is_missing(chunk, tmp_path):
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.3, 0.3, 0.3], [1.5, 0.5, 0.5]])
    heat = np.array([1.0, np.nan, 3.0, 7.0])
    WRITERS[".ply"](tmp_path / "in.ply", Table(points, {"heat": heat}))

    arguments = ["--voxel", 1, "--readout", "generated", *chunk]
    done(tmp_path / "in.ply", tmp_path / "out.npz", *arguments)

    means = read(tmp_path / "out.npz", 9, 0)
    np.testing.assert_allclose(means.points, [[0.2, 0.2, 0.2], [1.5, 0.5, 0.5]], atol=1e-9)
    np.testing.assert_array_equal(means.columns["heat"], [np.nan, 7.0])


def test_voxel_means_renormalise_normals_by_the_names_of_pcl(tmp_path):
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.3, 0.3, 0.3]])
    normals = {"normal_x": [1.0, 0.0, 0.0], "normal_y": [0.0, 1.0, 0.0], "normal_z": [0.0] * 3}
    columns = {name: np.array(values, np.float32) for name, values in normals.items()}
    WRITERS[".pcd"](tmp_path / "in.pcd", Table(points, columns))

    done(tmp_path / "in.pcd", tmp_path / "out.npz", "--voxel", 1, "--readout", "generated")

    mean = read(tmp_path / "out.npz", 9, 0)
    values = [float(mean.columns[name][0]) for name in normals]
    assert values == pytest.approx([2**-0.5, 2**-0.5, 0.0])


def test_map_of_a_spacing(scan, tmp_path):
    done(scan, tmp_path / "out.npz", "--spacing", 0.7, "--map", tmp_path / "map.npz")

    rows = np.load(tmp_path / "map.npz")["rows"]
    kept = read(tmp_path / "out.npz", 9, 0).points
    points = read(scan, 9, 0).points
    finite = np.isfinite(points).all(axis=1)
    distances = np.linalg.norm(points[finite] - kept[rows[finite, 0]], axis=1)
    assert distances.max() < 0.7


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--m", 5, "--spacing", 1], "give one of --m, --spacing and --voxel, got --m and --spac"),
        (["--spacing", 1, "--method", "fps"], "--spacing needs neither --method nor --weights"),
        (["--voxel", 0], "--voxel must be a number above 0, in the file's unit, got 0"),
        (["--spacing", "nan"], "--spacing must be a number above 0"),
        (["--spacing", 1, "--readout", "generated"], "--spacing keeps input points"),
        (["--voxel", 1, "--stratify", "row:share"], "--stratify shares a number of points"),
        (["--voxel", 1, "--space", "z=2"], "--space is for --method fps, --method poisson"),
        (["--spacing", "5cm"], "--spacing must be a number above 0, in the file's unit, such as"),
        (["--voxel", "10%"], "--voxel must be a number above 0, in the file's unit, such as"),
        (["--spacing", 1, "--space", "zz"], "has no column 'zz'"),
        (["--spacing", 1, "--space", "z=-1"], "--space must be columns with factors of at least 0"),
        (["--voxel", 1e-20], "is too small for coordinates"),
        (["--spacing", 1, "--total"], "--total is for --m"),
        (["--m", "0%", "--method", "fps"], "--m must be a whole number of at least 1, or a share"),
        (["--m", "100%", "--method", "fps"], "--m must be a whole number of at least 1, or a sh"),
        (["--m", "1.5", "--method", "fps"], "--m must be a whole number of at least 1, or a share"),
        (["--m", 5, "--method", "fps", "--stratify", "row"], "--stratify must be a column and"),
        (["--m", 5, "--method", "fps", "--stratify", "heat:share"], "'heat' must hold whole"),
        (["--m", 5, "--method", "random", "--space", "z=2"], "--space is for --method fps"),
    ],
)
def test_mistakes_are_one_line(options, words, scan, tmp_path):
    assert words in refused(scan, tmp_path / "out.npz", *options)
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize("budget", ["--spacing", "--voxel"])
def test_chunk_of_one_point_reads_longer_ranges(budget, tmp_path, monkeypatch):
    monkeypatch.setattr(by_distance, "LEAST_CHUNK", 4096)
    WRITERS[".ply"](tmp_path / "in.ply", Table(RNG.normal(size=(5000, 3))))
    ranges: list[range] = []
    monkeypatch.setattr(by_distance, "_read", watched(by_distance._read, ranges))
    done(tmp_path / "in.ply", tmp_path / "whole.ply", budget, 2.5)
    ranges.clear()

    done(tmp_path / "in.ply", tmp_path / "parts.ply", budget, 2.5, "--chunk", 1)

    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert {*ranges} == {range(4096), range(4096, 5000)}


def watched(read_part, ranges):
    def read_range(cloud, options, rows):
        ranges.append(rows)
        return read_part(cloud, options, rows)

    return read_range


@pytest.mark.parametrize("budget", ["--spacing", "--voxel"])
@pytest.mark.parametrize("options", [[], ["--chunk", 7]])
def test_weights_of_zero_are_named(budget, options, tmp_path):
    WRITERS[".ply"](tmp_path / "in.ply", Table(RNG.normal(size=(20, 3)), {"w": np.zeros(20)}))
    files = tmp_path / "in.ply", tmp_path / "out.ply"

    words = refused(*files, budget, 1, "--weight", "w", *options)

    assert f"--weight w of {files[0]}: all weights are 0" in words


@pytest.mark.parametrize("budget", ["--spacing", "--voxel"])
@pytest.mark.parametrize(
    ("name", "distance"), [("autzen_trim_7.las", 6), ("lone-star.copc.laz", 0.8)]
)
def test_real_scans_in_chunks_equal_one_pass(name, distance, budget, real_data, tmp_path):
    source = real_data(f"airborne/{name}")

    done(source, tmp_path / "whole.las", budget, distance)
    done(source, tmp_path / "parts.las", budget, distance, "--chunk", 200_000)

    whole, parts = read(tmp_path / "whole.las", 9, 0), read(tmp_path / "parts.las", 9, 0)
    assert len(whole.points) > 100
    np.testing.assert_array_equal(parts.points, whole.points)
    for column, values in whole.columns.items():
        np.testing.assert_array_equal(parts.columns[column], values)


@pytest.mark.parametrize(("kind", "is_refused"), [(2, True), (1, False)])
def test_degrees_told_by_keys_of_geotiff_are_refused(kind, is_refused, tmp_path):
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = np.full(3, 1e-7)
    citation, model = (1026, 34737, 8, 0), (1024, 0, 1, kind)
    keys = struct.pack("<12H", 1, 1, 0, 2, *model, *citation)
    header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", keys))
    las = laspy.LasData(header)
    las.x, las.y, las.z = RNG.uniform(8, 9, (3, 50))
    las.write(tmp_path / "in.las")

    if is_refused:
        words = refused(tmp_path / "in.las", tmp_path / "out.las", "--voxel", 0.05)
        assert f"the coordinates of {tmp_path / 'in.las'} are degrees" in words
    else:
        done(tmp_path / "in.las", tmp_path / "out.las", "--voxel", 0.05)


@pytest.mark.parametrize(
    ("wkt", "is_refused"),
    [
        ('GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]]]', True),
        ('PROJCS["WGS 84 / UTM zone 32N",GEOGCS["WGS 84",DATUM["WGS_1984"]]]', False),
    ],
)
@pytest.mark.parametrize("budget", ["--spacing", "--voxel"])
def test_degrees_are_refused(budget, wkt, is_refused, tmp_path):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 1e-7)
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    las = laspy.LasData(header)
    las.x, las.y, las.z = RNG.uniform(8, 9, (3, 50))
    las.write(tmp_path / "in.las")

    if is_refused:
        words = refused(tmp_path / "in.las", tmp_path / "out.las", budget, 0.05)
        assert f"{budget}: the coordinates of {tmp_path / 'in.las'} are degrees" in words
    else:
        done(tmp_path / "in.las", tmp_path / "out.las", budget, 0.05)
