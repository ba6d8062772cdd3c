"""Files by tiles, as the command does it."""

import numpy as np
import pytest

from mops_lightning import load
from mops_lightning.data.formats.registry import WRITERS, read
from mops_lightning.data.formats.table import Table
from tests.support.downsample import call


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """A cloud of 6,000 points with rows that are not finite."""
    path = tmp_path_factory.mktemp("scene") / "scan.ply"
    points = np.random.default_rng(0).normal(size=(6000, 3)) * [30, 10, 1] + [1000, 0, 0]
    points[100:140] = np.nan
    WRITERS[".ply"](path, Table(points, {"label": np.arange(6000)}))
    return path


@pytest.mark.parametrize(
    "options",
    [
        ["--tile", 512, "--m", 600],
        ["--tile-size", 8.0, "--m", 600],
        ["--tile", 512, "--ratio", 0.1],
        ["--tile", 512, "--m", 600, "--chunk", 900],
        ["--tile-size", 8.0, "--m", 600, "--chunk", 900],
    ],
)
def test_scene_keeps_rows_with_attributes(options, scan, tmp_path):
    target = tmp_path / "out.npz"
    arguments = ["--method", "fps", "--keep-attributes", *options]
    status, out, err = call(scan, target, *arguments)
    assert (status, err) == (0, "")
    number = 596 if "--ratio" in options else 600
    assert f"{number} of 5,960 points (40 more" in out
    assert "close pairs at seams left" in out
    kept, whole = read(target, 9, 0), read(scan, 9, 0)
    rows = kept.columns["label"].astype(int)
    assert len(set(rows)) == number
    np.testing.assert_array_equal(kept.points, whole.points[rows])
    assert [path.name for path in tmp_path.iterdir()] == ["out.npz"]


def test_scene_chunks_of_cubes_equal_memory(scan, tmp_path):
    options = ["--method", "fps", "--tile-size", 8.0, "--ratio", 1.0]
    for name, more in (("one", []), ("two", ["--chunk", 900])):
        assert call(scan, tmp_path / f"{name}.npy", *options, *more)[0] == 0
    np.testing.assert_array_equal(np.load(tmp_path / "one.npy"), np.load(tmp_path / "two.npy"))


def test_scene_trained_sampler_of_many_sizes(folder, tmp_path):
    source = folder / "in" / "a.ply"
    for more in ([], ["--chunk", 100]):
        target = tmp_path / f"{len(more)}.npy"
        options = ["--weights", folder, "--tile", 64, "--m", 120, *more]
        assert call(source, target, *options)[0] == 0
        assert len(np.unique(np.load(target), axis=0)) == 120


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--tile", 64, "--tile-size", 1.0, "--m", 9], "either --tile POINTS or --tile-size"),
        (["--tile", 1, "--m", 9], "--tile must be at least 2"),
        (["--tile-size", 0.0, "--m", 9], "--tile-size must be above 0"),
        (["--tile", 64], "--m"),
        (["--ratio", 0.5], "--ratio replaces --m"),
        (["--tile", 64, "--ratio", 1.5], "--ratio must be above 0 and at most 1"),
        (["--tile", 64, "--m", 9, "--chunk", 32], "--chunk must be at least --tile 64"),
        (["--tile", 64, "--m", 7000], "fewer than --m 7000"),
    ],
)
def test_scene_invalid_options_end_in_one_line(options, said, scan, tmp_path):
    status, out, err = call(scan, tmp_path / "out.npy", "--method", "fps", *options)
    assert (status, out) == (2, "")
    assert said in err
    assert len(err.splitlines()) == 1


def test_scene_loaded_sampler_equals_command(scan, tmp_path):
    name = "fmops.modelnet40-m512"
    assert call(scan, tmp_path / "out.npy", "--weights", name, "--m", 20)[0] == 0
    points = read(scan, 9, 0).finite().points
    chosen, rows = load(name).downsample(points, 20)
    np.testing.assert_array_equal(chosen, points[rows])
    assert {tuple(p) for p in chosen} == {tuple(p) for p in np.load(tmp_path / "out.npy")}
