"""Spacing and voxels of files: whole, in chunks, by Dask, in folders, with attributes and maps."""

import struct
from typing import Any

import laspy
import numpy as np
import pytest
from laspy.vlrs.vlrlist import VLRList
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning.data.formats.registry import read
from mops_lightning.files import by_distance
from mops_lightning.ops.spacing import keep_spaced
from tests.support.cloud_files import contents, write_cloud
from tests.support.clouds import uniform_points
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
        "hole": np.where(np.arange(900) == 7, np.nan, 1.0),
        "nx": normals[:, 0],
        "ny": normals[:, 1],
        "nz": normals[:, 2],
    }
    write_cloud(path, points, columns)
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


def test_mean_of_a_voxel_with_one_point_is_this_point_to_the_last_bit(tmp_path):
    source = tmp_path / "in.npz"
    result = tmp_path / "out.npz"
    random = np.random.default_rng(0)
    places = np.arange(100.0)[:, None] * [3, 0, 0]
    points = random.random((100, 3)) + places + [512_345.0, 5_412_345.0, 100.0]
    np.savez(source, points=points)

    done(source, result, "--voxel", 1, "--readout", "generated")

    alone = read(result, 1, 0).points
    voxels = np.floor(points)
    assert len(np.unique(voxels, axis=0)) == 100
    assert sorted(alone.tolist()) == sorted(points.tolist())


def test_spacing_in_many_passes_counts_the_points_of_all_ranges(tmp_path):
    source = tmp_path / "in.npy"
    points = uniform_points(200, 0)
    points[:20] *= 0.01  # one of these is kept early: the first ranges have no more to offer
    points[7] = np.nan
    np.save(source, points)

    out = done(source, tmp_path / "out.npz", "--spacing", 0.15, "--chunk", 10)

    kept = len(read(tmp_path / "out.npz", 1, 0).points)
    assert kept > 50  # of at most ten that a pass keeps
    assert f"{kept} of 199 points (1 more without finite coordinates left out)" in out


@pytest.mark.parametrize("budget", BUDGETS)
def test_chunks_and_tiles_equal_one_pass(budget, scan, tmp_path):
    done(scan, tmp_path / "whole.npz", *BUDGETS[budget])
    whole = contents(tmp_path / "whole.npz")

    for name, options in {
        "1000": ["--chunk", 1000],
        "250": ["--chunk", 250],
        "31": ["--chunk", 31],
        "tile": ["--tile", 64],
    }.items():
        done(scan, tmp_path / f"{name}.npz", *BUDGETS[budget], *options)
        part = contents(tmp_path / f"{name}.npz")
        assert_array_equal(part.points, whole.points)
        assert part.columns.keys() == whole.columns.keys()
        for column, values in whole.columns.items():
            assert_array_equal(part.columns[column], values)


@pytest.mark.parametrize("seed", [0, 3])
def test_spacing_keeps_rows_of_the_op(seed, scan, tmp_path):
    result = tmp_path / "out.npz"

    out = done(scan, result, "--spacing", 0.7, "--seed", seed)

    kept = contents(result)
    whole = contents(scan).finite()
    rows = keep_spaced(whole.points, 0.7, seed)
    assert_array_equal(kept.points, whole.points[rows])
    assert_array_equal(kept.columns["row"], whole.columns["row"][rows])
    assert f"{len(rows)} of 899 points (1 more without finite coordinates left out)" in out


def test_voxel_keeps_one_row_of_each_and_prints_the_origin(scan, tmp_path):
    result = tmp_path / "out.npz"

    out = done(scan, result, "--voxel", 0.8)

    kept = contents(result)
    whole = contents(scan)
    cells = np.floor(whole.finite().points / 0.8)
    occupied = np.unique(cells, axis=0)
    rows = kept.columns["row"]
    assert len(kept.points) == len(occupied)
    assert_array_equal(kept.points, whole.points[rows])
    assert_array_equal(rows, np.sort(rows))
    assert "voxels of 0.8 from the origin 0 0 0" in out


@pytest.fixture(scope="module")
def voxel_means(scan, tmp_path_factory):
    """The means of the voxels of 0.8, the points of the scan and the voxel of each."""
    result = tmp_path_factory.mktemp("means") / "out.npz"
    done(scan, result, "--voxel", 0.8, "--readout", "generated")
    whole = contents(scan).finite()
    cells = np.floor(whole.points / 0.8)
    _, voxel = np.unique(cells, axis=0, return_inverse=True)
    return contents(result), whole, voxel


def mean_by_voxel(voxel, values):
    return np.bincount(voxel, values) / np.bincount(voxel)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_voxel_means_average_coordinates(axis, voxel_means):
    means, whole, voxel = voxel_means

    expected = mean_by_voxel(voxel, whole.points[:, axis])

    assert_allclose(means.points[:, axis], expected, rtol=0, atol=2e-8)


def test_voxel_means_average_quantities_and_renormalise_normals(voxel_means):
    means, whole, voxel = voxel_means

    heat = mean_by_voxel(voxel, whole.columns["heat"])
    red = mean_by_voxel(voxel, whole.columns["red"])

    assert_allclose(means.columns["heat"], heat, rtol=1e-9, atol=1e-3)
    assert_allclose(means.columns["red"], red, atol=0.5)
    normals = [means.columns["nx"], means.columns["ny"], means.columns["nz"]]
    assert_allclose(np.linalg.norm(normals, axis=0), 1.0)


def test_voxel_means_keep_the_row_of_a_point_of_their_voxel(voxel_means):
    means, whole, voxel = voxel_means

    places = np.searchsorted(whole.columns["row"], means.columns["row"])

    assert_array_equal(voxel[places], np.arange(voxel.max() + 1))


@pytest.mark.parametrize("budget", [["--spacing", 0.7], ["--voxel", 0.8]])
def test_coordinates_alone_are_kept_on_request(budget, scan, tmp_path):
    done(scan, tmp_path / "out.npz", *budget)
    done(scan, tmp_path / "bare.npz", *budget, "--weight", "red", "--coordinates-only")

    assert "row" in contents(tmp_path / "out.npz").columns
    assert not contents(tmp_path / "bare.npz").columns


@pytest.mark.parametrize("chunk", [[], ["--chunk", 99]])
@pytest.mark.parametrize(
    "settings",
    [
        ["--voxel", 0.8],
        ["--method", "random", "--m", 20],
    ],
)
def test_points_outside_of_the_bounds_are_not_said_to_be_broken(settings, chunk, scan, tmp_path):
    bounds = "512345,5412345,512348,5412348"
    whole = contents(scan).finite().points
    is_inside = (whole[:, :2] <= [512348, 5412348]).all(1)

    out = done(scan, tmp_path / "out.npz", *settings, "--bounds", bounds, *chunk)

    assert f" of {is_inside.sum()} points, " in out


def test_voxel_means_of_float32_have_double_precision(tmp_path):
    points = np.array([[0.1, 0.2, 0.3], [0.2, 0.4, 0.4]], np.float32)
    source = tmp_path / "in.ply"
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    axes = "property float x\nproperty float y\nproperty float z\nend_header\n"
    source.write_bytes(f"{head}{axes}".encode() + points.tobytes())

    done(source, tmp_path / "out.ply", "--voxel", 1, "--readout", "generated")

    mean = points.astype(np.float64).mean(0)
    assert_allclose(contents(tmp_path / "out.ply").points, [mean], rtol=1e-12)


@pytest.mark.parametrize("chunk", [[], ["--chunk", 2]])
def test_voxel_mean_of_a_missing_value_is_missing(chunk, tmp_path):
    source = tmp_path / "in.ply"
    result = tmp_path / "out.npz"
    points = np.array(
        [
            [0.1, 0.1, 0.1],
            [0.2, 0.2, 0.2],
            [0.3, 0.3, 0.3],
            [1.5, 0.5, 0.5],
        ]
    )
    heat = np.array([1.0, np.nan, 3.0, 7.0])
    cold = np.array([-1e9, -2e9, -3e9, -7e9])
    write_cloud(source, points, {"heat": heat, "cold": cold})

    done(source, result, "--voxel", 1, "--readout", "generated", *chunk)

    means = contents(result)
    expected = [[0.2, 0.2, 0.2], [1.5, 0.5, 0.5]]
    assert_allclose(means.points, expected, atol=1e-9)
    assert_array_equal(means.columns["heat"], [np.nan, 7.0])
    assert_allclose(means.columns["cold"], [-2e9, -7e9], rtol=1e-9)


def test_voxel_means_renormalise_normals_by_the_names_of_pcl(tmp_path):
    source = tmp_path / "in.pcd"
    result = tmp_path / "out.npz"
    points = np.array(
        [
            [0.1, 0.1, 0.1],
            [0.2, 0.2, 0.2],
            [0.3, 0.3, 0.3],
        ]
    )
    columns = {
        "normal_x": np.array([1.0, 0.0, 0.0], np.float32),
        "normal_y": np.array([0.0, 1.0, 0.0], np.float32),
        "normal_z": np.array([0.0, 0.0, 0.0], np.float32),
    }
    write_cloud(source, points, columns)

    done(source, result, "--voxel", 1, "--readout", "generated")

    mean = contents(result).columns
    assert mean["normal_x"] == pytest.approx([2**-0.5])
    assert mean["normal_y"] == pytest.approx([2**-0.5])
    assert mean["normal_z"] == pytest.approx([0.0])


def test_map_of_a_spacing(scan, tmp_path):
    result = tmp_path / "out.npz"
    map_ = tmp_path / "map.npz"

    done(scan, result, "--spacing", 0.7, "--map", map_)

    points = contents(scan).points
    is_finite = np.isfinite(points).all(axis=1)
    rows = np.load(map_)["rows"][is_finite, 0]
    kept = contents(result).points[rows]
    distances = np.linalg.norm(points[is_finite] - kept, axis=1)
    assert distances.max() < 0.7


def test_map_of_fewer_points_than_its_rows_has_all_of_them(tmp_path):
    points = uniform_points(30, 0)
    np.save(tmp_path / "in.npy", points)
    map_ = tmp_path / "map.npz"

    done(tmp_path / "in.npy", tmp_path / "out.npy", "--spacing", 99, "--map", map_, "--map-k", 4)

    assert np.load(map_)["rows"].tolist() == [[0]] * 30


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
        (["--spacing", 1, "--space", "hole"], "--space: 'hole' of"),
        (["--spacing", 1, "--weight", "curvature", "--chunk", 99], "leave --chunk out"),
        (["--spacing", 1, "--space", "z=-1"], "--space must be columns with factors of at least 0"),
        (
            ["--spacing", 1, "--space", "z=2,z=3"],
            "--space must be columns with factors of at least",
        ),
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
    source = tmp_path / "in.ply"
    whole = tmp_path / "whole.ply"
    parts = tmp_path / "parts.ply"
    monkeypatch.setattr(by_distance, "LEAST_CHUNK", 4096)
    write_cloud(source, RNG.normal(size=(5000, 3)))
    done(source, whole, budget, 2.5)
    ranges: list[range] = []
    monkeypatch.setattr(by_distance, "_read", watched(by_distance._read, ranges))

    done(source, parts, budget, 2.5, "--chunk", 1)

    assert parts.read_bytes() == whole.read_bytes()
    assert set(ranges) == {range(4096), range(4096, 5000)}


def watched(read_part, ranges):
    def read_range(cloud, options, rows):
        ranges.append(rows)
        return read_part(cloud, options, rows)

    return read_range


@pytest.mark.parametrize("budget", ["--spacing", "--voxel"])
@pytest.mark.parametrize("options", [[], ["--chunk", 7]])
def test_weights_of_zero_are_named(budget, options, tmp_path):
    source = tmp_path / "in.ply"
    points = RNG.normal(size=(20, 3))
    write_cloud(source, points, {"w": np.zeros(20)})

    words = refused(source, tmp_path / "out.ply", budget, 1, "--weight", "w", *options)

    assert f"--weight w of {source}: all weights are 0" in words


@pytest.mark.parametrize("budget", ["--spacing", "--voxel"])
@pytest.mark.parametrize(
    ("name", "distance"),
    [
        ("autzen_trim_7.las", 6),
        ("lone-star.copc.laz", 0.8),
    ],
)
def test_real_scans_in_chunks_equal_one_pass(name, distance, budget, real_data, tmp_path):
    source = real_data(f"airborne/{name}")

    done(source, tmp_path / "whole.las", budget, distance)
    done(source, tmp_path / "parts.las", budget, distance, "--chunk", 200_000)

    whole = contents(tmp_path / "whole.las")
    parts = contents(tmp_path / "parts.las")
    assert len(whole.points) > 100
    assert_array_equal(parts.points, whole.points)
    for column, values in whole.columns.items():
        assert_array_equal(parts.columns[column], values)


@pytest.mark.parametrize(("kind", "is_refused"), [(2, True), (1, False)])
def test_degrees_told_by_keys_of_geotiff_are_refused(kind, is_refused, tmp_path):
    source = tmp_path / "in.las"
    out = tmp_path / "out.las"
    version = (1, 1, 0, 2)
    model = (1024, 0, 1, kind)
    citation = (1026, 34737, 8, 0)
    keys = struct.pack("<12H", *version, *model, *citation)
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = np.full(3, 1e-7)
    header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", keys))
    las = laspy.LasData(header)
    las.x, las.y, las.z = RNG.uniform(8, 9, (3, 50))
    las.write(source)

    if is_refused:
        words = refused(source, out, "--voxel", 0.05)
        assert f"the coordinates of {source} are degrees" in words
    else:
        done(source, out, "--voxel", 0.05)


@pytest.mark.parametrize(
    ("wkt", "is_refused"),
    [
        ('GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]]]', True),
        ('PROJCS["WGS 84 / UTM zone 32N",GEOGCS["WGS 84",DATUM["WGS_1984"]]]', False),
        ('GEOGCRS["WGS 84",DATUM["World Geodetic System 1984"]]', True),
        ('PROJCRS["WGS 84 / UTM zone 32N",BASEGEOGCRS["WGS 84"]]', False),
    ],
)
@pytest.mark.parametrize(
    ("budget", "place"),
    [
        ("--spacing", "before the points"),
        ("--voxel", "before the points"),
        ("--spacing", "after the points"),
    ],
)
def test_degrees_are_refused(budget, place, wkt, is_refused, tmp_path):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 1e-7)
    crs = laspy.vlrs.known.WktCoordinateSystemVlr(wkt)
    if place == "before the points":
        header.vlrs.append(crs)
    else:
        header.evlrs = VLRList([crs])
    las = laspy.LasData(header)
    las.x, las.y, las.z = RNG.uniform(8, 9, (3, 50))
    las.write(tmp_path / "in.las")

    if is_refused:
        words = refused(tmp_path / "in.las", tmp_path / "out.las", budget, 0.05)
        assert f"{budget}: the coordinates of {tmp_path / 'in.las'} are degrees" in words
    else:
        done(tmp_path / "in.las", tmp_path / "out.las", budget, 0.05)
