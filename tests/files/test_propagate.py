"""The map of a downsampled file, and the subcommand ``propagate``."""

from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

import mops_lightning
from mops_lightning.data.formats.registry import WRITERS, read
from mops_lightning.data.formats.table import Table
from mops_lightning.files import propagate as module
from mops_lightning.files.cli import propagate as main
from mops_lightning.ops import propagation
from tests.support.captured import captured, done, refused
from tests.support.downsample import call as downsample
from tests.support.downsample import refused as not_downsampled

FIELD = ["--field", "label"]


def call(*arguments):
    return captured(main, arguments)


def contents(path):
    return read(path, 9, 0)


@pytest.fixture(autouse=True)
def small_parts(monkeypatch):
    monkeypatch.setattr(module, "PART", 60)


@pytest.fixture
def scan(tmp_path):
    """500 points far from the origin, of which 20 are not finite, in a file."""
    points = np.random.default_rng(1).normal([400_000, 5_000_000, 0], 1, (500, 3))
    points[100:120] = np.nan
    columns = {"intensity": np.arange(500, dtype=np.uint16)}
    WRITERS[".ply"](tmp_path / "big.ply", Table(points, columns))
    return tmp_path / "big.ply"


def nearest(points, sampled):
    return np.linalg.norm(points[:, None] - sampled, axis=2).argmin(1)


def test_map_leads_from_sample_to_all_points(scan, tmp_path):
    map_, small = tmp_path / "map.npz", tmp_path / "small.ply"
    arguments = ["--m", 30, "--method", "fps", "--map", map_]
    status, _, err = downsample(scan, small, *arguments)
    assert (status, err) == (0, "")
    points, sample = contents(scan).points, contents(small)
    labels = np.arange(30) + 2**60
    carried = mops_lightning.propagate(labels, map_, fill=-1)
    assert len(carried) == 500
    finite = np.isfinite(points).all(1)
    np.testing.assert_array_equal(carried[~finite], -1)
    expected = labels[nearest(points[finite], sample.points)]
    np.testing.assert_array_equal(carried[finite], expected)
    assert (np.load(map_)["rows"][sample.columns["intensity"], 0] >= 0).all()


def test_map_with_several_rows_averages_scores(scan, tmp_path):
    map_, small = tmp_path / "new" / "map.npz", tmp_path / "small.npz"
    arguments = ["--m", 30, "--method", "random", "--map", map_, "--map-k", 4]
    assert downsample(scan, small, *arguments)[0] == 0
    points = contents(scan).finite().points
    sampled = contents(small).points
    distances = np.linalg.norm(points[:, None] - sampled, axis=2)
    rows = distances.argsort(1)[:, :4]
    inverse = np.maximum(np.take_along_axis(distances, rows, 1), 1e-12) ** -2
    scores = np.random.default_rng(2).random(30)
    expected = (scores[rows] * inverse).sum(1) / inverse.sum(1)
    carried = mops_lightning.propagate(scores, map_, fill=np.nan)
    np.testing.assert_allclose(carried[np.isfinite(carried)], expected, rtol=1e-5)


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
    settings = ["--m", 8, "--method", "fps"]
    assert said in not_downsampled("big.ply", "small.npz", *settings, *arguments)
    said = not_downsampled(tmp_path, "out", *settings, "--map", "map.npz")
    assert "--map is the map of one file" in said


@pytest.mark.parametrize("source", [".ply", ".las", ".laz", ".npy", ".npz", ".xyz"])
@pytest.mark.parametrize("target", [".ply", ".las", ".laz"])
def test_labels_reach_all_points(source, target, tmp_path):
    random = np.random.default_rng(1)
    points = random.normal(size=(200, 3)).astype(np.float32).astype(float)
    big, small, out = tmp_path / f"big{source}", tmp_path / "small.npz", tmp_path / f"out{target}"
    WRITERS[source](big, Table(points, {"intensity": np.arange(200, dtype=np.uint16)}))
    labels = np.arange(20) + 2**30
    classes = np.array([3] * 10 + [200] * 10, np.uint8)  # a LAS class of old files is below 32
    columns: dict[str, Any] = {"label": labels, "classification": classes}
    columns["score"] = random.random(20)
    WRITERS[".npz"](small, Table(points[:20], columns))
    fields = [word for name in columns for word in ("--field", name)]
    said = done(main, [small, big, out, *fields])
    assert "label, classification, score of 200 points" in said
    made = contents(out)
    np.testing.assert_allclose(made.points, points, atol=1e-6)
    rows = nearest(contents(big).points, points[:20])
    np.testing.assert_array_equal(made.columns["label"], labels[rows])
    np.testing.assert_array_equal(made.columns["score"], columns["score"][rows])
    # LAS keeps numbers that its own column cannot hold in a column beside it.
    name = "classification_" if "classification_" in made.columns else "classification"
    np.testing.assert_array_equal(made.columns[name], classes[rows])
    if source not in (".npy",):
        np.testing.assert_array_equal(made.columns["intensity"], np.arange(200))


def test_points_without_coordinates_are_left_out_and_columns_kept(scan, tmp_path):
    sample = contents(scan).take(np.arange(0, 90, 3))
    WRITERS[".ply"](tmp_path / "small.ply", Table(sample.points, {"label": np.arange(30)}))
    done(main, [tmp_path / "small.ply", scan, "--field", "label"])
    made = contents(tmp_path / "big_propagated.ply")
    whole = contents(scan).finite()
    np.testing.assert_array_equal(made.points, whole.points)
    np.testing.assert_array_equal(made.columns["intensity"], whole.columns["intensity"])
    np.testing.assert_array_equal(made.columns["label"], nearest(whole.points, sample.points))


def test_parts_share_one_tree_of_the_sample(scan, tmp_path, monkeypatch):
    sample = contents(scan).take(np.arange(0, 90, 3))
    built = []

    def counted(rows: Any) -> Any:
        built.append(rows)
        return cKDTree(rows)

    monkeypatch.setattr(propagation, "cKDTree", counted)
    scores = np.random.default_rng(1).random(30)
    WRITERS[".ply"](tmp_path / "small.ply", Table(sample.points, {"score": scores}))
    assert call(tmp_path / "small.ply", scan, "--field", "score", "--k", 3)[0] == 0
    assert len(built) == 1
    whole = propagation.propagation_map(contents(scan).finite().points, sample.points, 3)
    made = contents(tmp_path / "big_propagated.ply").columns["score"]
    np.testing.assert_allclose(made, mops_lightning.propagate(scores, whole), atol=1e-12)


@pytest.mark.parametrize("target", [".ply", ".las"])
def test_later_parts_may_have_larger_and_broken_numbers(target, tmp_path):
    points = np.random.default_rng(1).random((180, 3))
    large = np.arange(180) + 2**31 - 70  # int32 holds those of the first part
    rows = np.zeros(180, [*((axis, "f8") for axis in "xyz"), ("large", "i8"), ("intensity", "f8")])
    rows["x"], rows["y"], rows["z"] = points.T
    rows["large"], rows["intensity"] = large, np.where(np.arange(180) > 100, 0.5, 3)
    np.save(tmp_path / "big.npy", rows)
    WRITERS[".npz"](tmp_path / "small.npz", Table(points[:5], {"label": np.arange(5)}))
    files = [tmp_path / "small.npz", tmp_path / "big.npy", tmp_path / f"out{target}"]
    assert call(*files, "--field", "label")[0] == 0
    made = contents(files[2]).columns
    np.testing.assert_array_equal(made["large"], large)
    name = "intensity_" if target == ".las" else "intensity"
    np.testing.assert_array_equal(made[name], rows["intensity"])


def test_fraction_between_the_smallest_and_the_largest_number_is_kept(tmp_path):
    """LAS has whole intensities, which hold the smallest and the largest number here."""
    points = np.random.default_rng(1).random((180, 3))
    rows = np.zeros(180, [*((axis, "f8") for axis in "xyz"), ("intensity", "f8")])
    rows["x"], rows["y"], rows["z"] = points.T
    rows["intensity"][[70, 100]] = 0.5, 3
    np.save(tmp_path / "big.npy", rows)
    WRITERS[".npz"](tmp_path / "small.npz", Table(points[:5], {"label": np.arange(5)}))

    done(main, [*(tmp_path / name for name in ("small.npz", "big.npy", "out.las")), *FIELD])

    made = contents(tmp_path / "out.las").columns
    np.testing.assert_array_equal(made["intensity_"], rows["intensity"])


def test_first_part_far_from_the_last_one_keeps_its_place(tmp_path):
    """The whole-number steps of LAS must reach from one to the other."""
    points = np.random.default_rng(1).random((120, 3))
    points[:60] += [3_000_000, 5_000_000, 0]
    np.save(tmp_path / "big.npy", points)
    WRITERS[".npz"](tmp_path / "small.npz", Table(points[:3], {"label": np.arange(3)}))

    done(main, [*(tmp_path / name for name in ("small.npz", "big.npy", "out.las")), *FIELD])

    np.testing.assert_allclose(contents(tmp_path / "out.las").points, points, atol=0.01)


def test_colours_are_averaged_and_labels_vote(tmp_path):
    line = np.arange(5.0)[:, None] * [1, 0, 0]
    WRITERS[".npz"](tmp_path / "big.npz", Table(line, {}))
    columns = {"label": np.array([5, 9, 9]), "red": np.array([0, 100, 100], np.uint8)}
    WRITERS[".npz"](tmp_path / "small.npz", Table(line[[0, 2, 4]], columns))
    files = [tmp_path / "small.npz", tmp_path / "big.npz"]
    assert call(*files, tmp_path / "a.ply", "--field", "label", "--k", 3)[0] == 0
    assert contents(tmp_path / "a.ply").columns["label"].tolist() == [5, 9, 9, 9, 9]
    assert call(*files, tmp_path / "b.ply", "--field", "red", "--k", 2, "--mean")[0] == 0
    assert contents(tmp_path / "b.ply").columns["red"].tolist() == [0, 50, 100, 100, 100]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["small.npz", "big.npz", "--field", "lable"], "no column 'lable'. Did you mean 'label'?"),
        (["small.npz", "big.npz", "--field", "label", "--k", 4], "--k must be from 1 to the 3"),
        (
            ["small.npz", "big.npz", "out.obj", "--field", "label"],
            "OUT must end in .ply, .las, .laz, .copc.laz, got",
        ),
        (["small.npz", "mesh.ply", "mesh.ply", "--field", "label"], "OUT must differ"),
        (["small.npz", "big.npz", "old.ply", "--field", "label"], "old.ply exists"),
        (["small.npz", "nowhere.ply", "--field", "label"], "nowhere.ply: no such file"),
        (["nowhere.ply", "big.npz", "--field", "label"], "nowhere.ply: no such file"),
        (["small.npz", "empty.npz", "--field", "label"], "must be a cloud of at least one point"),
        (["small.npz", "mesh.ply", "--field", "label"], "must be a cloud of at least one point"),
        (["small.npz", "mesh.off", "out.ply", "--field", "label"], "mesh.off must end in .ply"),
        (["small.npz", ".", "--field", "label"], ".: not a file"),
        (["small.npz", "", "--field", "label"], ".: not a file"),
        (["small.npz", "/", "--field", "label"], "/: not a file"),
    ],
)
def test_mistake_ends_in_one_line(arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = np.arange(5.0)[:, None] * [1, 0, 0]
    WRITERS[".npz"](tmp_path / "big.npz", Table(line, {}))
    WRITERS[".npz"](tmp_path / "small.npz", Table(line[:3], {"label": np.arange(3)}))
    (tmp_path / "old.ply").touch()
    WRITERS[".npz"](tmp_path / "empty.npz", Table(line[:0], {}))
    trimesh.creation.box().export(tmp_path / "mesh.ply")
    trimesh.creation.box().export(tmp_path / "mesh.off")
    before = sorted(tmp_path.iterdir())
    assert said in refused(main, arguments)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("kind", ["f4", "u4"])
def test_packed_colours_are_averaged_channel_by_channel(kind, tmp_path):
    line = np.arange(3.0)[:, None] * [1, 0, 0]
    bytes_of_colours = np.array([[0, 0, 200, 0], [100, 2, 0, 0]], np.uint8)  # blue, green, red
    packed = bytes_of_colours.view(f"<{kind}")[:, 0]
    WRITERS[".npz"](tmp_path / "big.npz", Table(line, {}))
    WRITERS[".pcd"](tmp_path / "small.pcd", Table(line[[0, 2]], {"rgb": packed}))
    files = [tmp_path / "small.pcd", tmp_path / "big.npz", tmp_path / "out.ply"]

    done(main, [*files, "--field", "rgb", "--k", 2, "--mean"])

    carried = np.ascontiguousarray(contents(tmp_path / "out.ply").columns["rgb"])
    assert carried.view(np.uint8).reshape(-1, 4).tolist() == [
        [0, 0, 200, 0],
        [50, 1, 100, 0],
        [100, 2, 0, 0],
    ]


def test_packed_colours_of_whole_numbers_are_carried_unmixed_without_mean(tmp_path):
    line = np.arange(3.0)[:, None] * [1, 0, 0]
    packed = np.array([200, 512], np.uint32)
    WRITERS[".npz"](tmp_path / "big.npz", Table(line, {}))
    WRITERS[".pcd"](tmp_path / "small.pcd", Table(line[[0, 2]], {"rgb": packed}))
    files = [tmp_path / "small.pcd", tmp_path / "big.npz", tmp_path / "out.ply"]

    done(main, [*files, "--field", "rgb", "--k", 2])

    carried = contents(tmp_path / "out.ply").columns["rgb"].tolist()
    assert carried[0] == 200
    assert carried[1] in (200, 512)
    assert carried[2] == 512


def test_double_coordinates_near_the_origin_keep_every_bit(tmp_path):
    points = np.random.default_rng(1).random((50, 3))
    np.save(tmp_path / "big.npy", points)
    WRITERS[".npz"](tmp_path / "small.npz", Table(points[:3], {"label": np.arange(3)}))

    done(main, [tmp_path / "small.npz", tmp_path / "big.npy", "--field", "label"])

    np.testing.assert_array_equal(contents(tmp_path / "big_propagated.ply").points, points)
