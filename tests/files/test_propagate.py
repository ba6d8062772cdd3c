"""The map of a downsampled file, and the subcommand ``propagate``."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree

import mops_lightning
from mops_lightning.files import propagate as module
from mops_lightning.files.cli import propagate as main
from mops_lightning.ops import propagation
from tests.support.captured import done
from tests.support.cloud_files import contents, write_cloud
from tests.support.clouds import line_of, normal_points, uniform_points
from tests.support.downsample import call as downsample
from tests.support.downsample import refused as not_downsampled

FIELD = ["--field", "label"]


@pytest.fixture(autouse=True)
def small_parts(monkeypatch):
    monkeypatch.setattr(module, "PART", 60)


@pytest.fixture
def scan(tmp_path):
    """500 points far from the origin, of which 20 are not finite, in a file."""
    points = normal_points(500, 1)
    points += [400_000, 5_000_000, 0]
    points[100:120] = np.nan
    columns = {"intensity": np.arange(500, dtype=np.uint16)}
    write_cloud(tmp_path / "big.ply", points, columns)
    return tmp_path / "big.ply"


def distances_between(points, sampled):
    differences = points[:, None] - sampled
    return np.linalg.norm(differences, axis=2)


def nearest(points, sampled):
    distances = distances_between(points, sampled)
    return distances.argmin(1)


def write_labelled(path, points):
    """Write points whose labels are their rows."""
    write_cloud(path, points, {"label": np.arange(len(points))})


def write_scan(path, points, **columns):
    """Write a structured array with coordinates of float64 and other columns."""
    fields = [("x", "f8"), ("y", "f8"), ("z", "f8")]
    for name, values in columns.items():
        fields.append((name, values.dtype))
    rows = np.zeros(len(points), fields)
    rows["x"] = points[:, 0]
    rows["y"] = points[:, 1]
    rows["z"] = points[:, 2]
    for name, values in columns.items():
        rows[name] = values
    np.save(path, rows)


def test_map_leads_from_sample_to_all_points(scan, tmp_path):
    map_ = tmp_path / "map.npz"
    small = tmp_path / "small.ply"
    settings = ["--m", 30, "--method", "fps", "--map", map_]

    status, _, err = downsample(scan, small, *settings)

    assert status == 0
    assert err == ""
    points = contents(scan).points
    sample = contents(small)
    labels = np.arange(30) + 2**60
    carried = mops_lightning.propagate(labels, map_, fill=-1)
    is_finite = np.isfinite(points).all(1)
    nearest_rows = nearest(points[is_finite], sample.points)
    assert len(carried) == 500
    assert_array_equal(carried[~is_finite], -1)
    assert_array_equal(carried[is_finite], labels[nearest_rows])
    rows = np.load(map_)["rows"]
    rows_of_sample = rows[sample.columns["intensity"], 0]
    assert (rows_of_sample >= 0).all()


def test_map_with_several_rows_averages_scores(scan, tmp_path):
    map_ = tmp_path / "new" / "map.npz"
    small = tmp_path / "small.npz"
    scores = np.random.default_rng(2).random(30)
    settings = ["--m", 30, "--method", "random", "--map", map_, "--map-k", 4]

    status, _, _ = downsample(scan, small, *settings)

    assert status == 0
    points = contents(scan).finite().points
    sample = contents(small).points
    distances = distances_between(points, sample)
    order = distances.argsort(1)
    rows = order[:, :4]
    near = np.take_along_axis(distances, rows, 1)
    inverse = np.maximum(near, 1e-12) ** -2
    weights = inverse / inverse.sum(1, keepdims=True)
    shares = scores[rows] * weights
    expected = shares.sum(1)
    carried = mops_lightning.propagate(scores, map_, fill=np.nan)
    is_finite = np.isfinite(carried)
    assert_allclose(carried[is_finite], expected, rtol=1e-5)


def test_map_of_a_folder_gets_one_line(scan, tmp_path):
    settings = ["--m", 8, "--method", "fps", "--map", "map.npz"]

    said = not_downsampled(tmp_path, "out", *settings)

    assert "--map is the map of one file" in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--map", "map.txt"], "--map must end in .npz, got map.txt"),
        (["--map", "big.ply.npz", "--map-k", 0], "--map-k must be from 1 to --m, got 0"),
        (["--map", "map.npz", "--map-k", 9], "--map-k must be from 1 to --m, got 9"),
        (["--map-k", 3], "--map-k 3 has no effect without --map"),
        (["--map", "old.npz"], "old.npz exists. Give another --map, or --overwrite"),
        (["--map", "map.npz", "--chunk", 60], "--map needs the whole cloud in memory: use"),
        (["--map", "small.npz"], "--map must differ from IN and OUT"),
    ],
)
def test_wrong_map_of_downsample_gets_one_line(arguments, said, scan, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old.npz").touch()
    settings = ["--m", 8, "--method", "fps", *arguments]

    line = not_downsampled("big.ply", "small.npz", *settings)

    assert said in line


@pytest.mark.parametrize("source", [".ply", ".las", ".laz", ".npy", ".npz", ".xyz"])
@pytest.mark.parametrize("target", [".ply", ".las", ".laz"])
def test_labels_reach_all_points(source, target, tmp_path):
    random = np.random.default_rng(1)
    in_float32 = random.normal(size=(200, 3)).astype(np.float32)
    points = in_float32.astype(float)
    intensity = np.arange(200, dtype=np.uint16)
    labels = np.arange(20) + 2**30
    classes = np.full(20, 3, np.uint8)
    classes[10:] = 200  # a LAS class of old files is below 32
    scores = random.random(20)
    columns: dict[str, Any] = {
        "label": labels,
        "classification": classes,
        "score": scores,
    }
    big = tmp_path / f"big{source}"
    small = tmp_path / "small.npz"
    out = tmp_path / f"out{target}"
    write_cloud(big, points, {"intensity": intensity})
    write_cloud(small, points[:20], columns)
    fields = ["--field", "label", "--field", "classification", "--field", "score"]

    said = done(main, [small, big, out, *fields])

    assert "label, classification, score of 200 points" in said
    made = contents(out)
    given = contents(big)
    rows = nearest(given.points, points[:20])
    assert_allclose(made.points, points, atol=1e-6)
    assert_array_equal(made.columns["label"], labels[rows])
    assert_array_equal(made.columns["score"], scores[rows])
    # LAS keeps numbers that its own column cannot hold in a column beside it.
    name = "classification_" if "classification_" in made.columns else "classification"
    assert_array_equal(made.columns[name], classes[rows])
    if source != ".npy":  # a plain array has no names of columns
        assert_array_equal(made.columns["intensity"], intensity)


def test_points_without_coordinates_are_left_out_and_columns_kept(scan, tmp_path):
    small = tmp_path / "small.ply"
    every_third = np.arange(0, 90, 3)
    sample = contents(scan).take(every_third)
    write_cloud(small, sample.points, {"label": np.arange(30)})

    done(main, [small, scan, *FIELD])

    made = contents(tmp_path / "big_propagated.ply")
    whole = contents(scan).finite()
    rows = nearest(whole.points, sample.points)
    assert_array_equal(made.points, whole.points)
    assert_array_equal(made.columns["intensity"], whole.columns["intensity"])
    assert_array_equal(made.columns["label"], rows)


def test_parts_share_one_tree_of_the_sample(scan, tmp_path, monkeypatch):
    built = []

    def counted(rows: Any) -> Any:
        built.append(rows)
        return cKDTree(rows)

    monkeypatch.setattr(propagation, "cKDTree", counted)
    small = tmp_path / "small.ply"
    every_third = np.arange(0, 90, 3)
    sample = contents(scan).take(every_third)
    scores = np.random.default_rng(1).random(30)
    write_cloud(small, sample.points, {"score": scores})

    done(main, [small, scan, "--field", "score", "--k", 3])

    assert len(built) == 1
    points = contents(scan).finite().points
    whole = propagation.propagation_map(points, sample.points, 3)
    expected = mops_lightning.propagate(scores, whole)
    made = contents(tmp_path / "big_propagated.ply")
    assert_allclose(made.columns["score"], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("target", "name"),
    [
        (".ply", "intensity"),
        (".las", "intensity_"),
    ],
)
def test_later_parts_may_have_larger_and_broken_numbers(target, name, tmp_path):
    points = uniform_points(180, 1)
    large = np.arange(180) + 2**31 - 70  # int32 holds those of the first part
    intensity = np.full(180, 3.0)
    intensity[101:] = 0.5
    small = tmp_path / "small.npz"
    big = tmp_path / "big.npy"
    out = tmp_path / f"out{target}"
    write_scan(big, points, large=large, intensity=intensity)
    write_labelled(small, points[:5])

    done(main, [small, big, out, *FIELD])

    made = contents(out).columns
    assert_array_equal(made["large"], large)
    assert_array_equal(made[name], intensity)


def test_fraction_between_the_smallest_and_the_largest_number_is_kept(tmp_path):
    """LAS has whole intensities, which hold the smallest and the largest number here."""
    points = uniform_points(180, 1)
    intensity = np.zeros(180)
    intensity[70] = 0.5
    intensity[100] = 3
    small = tmp_path / "small.npz"
    big = tmp_path / "big.npy"
    out = tmp_path / "out.las"
    write_scan(big, points, intensity=intensity)
    write_labelled(small, points[:5])

    done(main, [small, big, out, *FIELD])

    made = contents(out).columns
    assert_array_equal(made["intensity_"], intensity)


def test_first_part_far_from_the_last_one_keeps_its_place(tmp_path):
    """The whole-number steps of LAS must reach from one to the other."""
    points = uniform_points(120, 1)
    points[:60] += [3_000_000, 5_000_000, 0]
    small = tmp_path / "small.npz"
    big = tmp_path / "big.npy"
    out = tmp_path / "out.las"
    np.save(big, points)
    write_labelled(small, points[:3])

    done(main, [small, big, out, *FIELD])

    made = contents(out)
    assert_allclose(made.points, points, atol=0.01)


@pytest.fixture
def line_files(tmp_path):
    """Five points on a line, and a sample of three with a label and a colour."""
    small = tmp_path / "small.npz"
    big = tmp_path / "big.npz"
    line = line_of(5)
    label = np.array([5, 9, 9])
    red = np.array([0, 100, 100], np.uint8)
    columns: dict[str, Any] = {"label": label, "red": red}
    write_cloud(big, line)
    write_cloud(small, line[[0, 2, 4]], columns)
    return [small, big]


def test_labels_of_several_sampled_points_vote(line_files, tmp_path):
    out = tmp_path / "out.ply"

    done(main, [*line_files, out, *FIELD, "--k", 3])

    label = contents(out).columns["label"]
    assert label.tolist() == [5, 9, 9, 9, 9]


def test_colours_are_averaged_on_request(line_files, tmp_path):
    out = tmp_path / "out.ply"

    done(main, [*line_files, out, "--field", "red", "--k", 2, "--mean"])

    red = contents(out).columns["red"]
    assert red.tolist() == [0, 50, 100, 100, 100]


@pytest.mark.parametrize("name", ["rgb", "rgba"])
@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("f4", ["--mean"]),
        ("u4", ["--mean"]),
        ("f4", []),
    ],
)
def test_packed_colours_are_averaged_channel_by_channel(kind, settings, name, tmp_path):
    line = line_of(3)
    blue_green_red_alpha = [
        [0, 0, 200, 4],
        [100, 2, 0, 0],
    ]
    bytes_of_colours = np.array(blue_green_red_alpha, np.uint8)
    packed = bytes_of_colours.view(f"<{kind}")[:, 0]
    small = tmp_path / "small.pcd"
    big = tmp_path / "big.npz"
    out = tmp_path / "out.ply"
    write_cloud(big, line)
    write_cloud(small, line[[0, 2]], {name: packed})

    done(main, [small, big, out, "--field", name, "--k", 2, *settings])

    carried = np.ascontiguousarray(contents(out).columns[name])
    bytes_of_carried = carried.view(np.uint8).reshape(-1, 4)
    assert bytes_of_carried.tolist() == [
        [0, 0, 200, 4],
        [50, 1, 100, 2],
        [100, 2, 0, 0],
    ]


def test_packed_colours_of_whole_numbers_are_carried_unmixed_without_mean(tmp_path):
    line = line_of(3)
    packed = np.array([200, 512], np.uint32)
    small = tmp_path / "small.pcd"
    big = tmp_path / "big.npz"
    out = tmp_path / "out.ply"
    write_cloud(big, line)
    write_cloud(small, line[[0, 2]], {"rgb": packed})

    done(main, [small, big, out, "--field", "rgb", "--k", 2])

    carried = contents(out).columns["rgb"].tolist()
    assert carried[0] == 200
    assert carried[1] in (200, 512)
    assert carried[2] == 512


def test_double_coordinates_near_the_origin_keep_every_bit(tmp_path):
    small = tmp_path / "small.npz"
    big = tmp_path / "big.npy"
    points = uniform_points(50, 1)
    np.save(big, points)
    write_labelled(small, points[:3])

    done(main, [small, big, *FIELD])

    made = contents(tmp_path / "big_propagated.ply")
    assert_array_equal(made.points, points)
