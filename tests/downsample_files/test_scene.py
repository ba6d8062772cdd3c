"""Files by tiles, as the command does it."""

import re

import numpy as np
import pytest

from mops_lightning import load
from mops_lightning.config.compose import compose
from mops_lightning.data.formats.registry import WRITERS, read
from mops_lightning.data.formats.table import Table
from mops_lightning.training.run import run
from tests.support.command_line import TINY_ANY_DATA
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


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder of scans with colours of 16 bits, and the run that trained a sampler on it."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "scans").mkdir()
    for seed in range(3):
        points = np.random.default_rng(seed).normal(size=(400, 3)) * [9, 5, 1] + [1000, 0, 0]
        red = ((points[:, 1] > 0) * 60_000).astype("u2")
        WRITERS[".ply"](folder / "scans" / f"{seed}.ply", Table(points, {"red": red}))
    overrides = [
        *("task=reconstruction", "dataset=clouds", f"dataset.root={folder}/scans", *TINY_ANY_DATA),
        *("dataset.features=[red]", "dataset.crops=4", "sampler=fmops", "sampler.m_max=32"),
        *("sizes=[8]", "trainer.max_epochs=6", "task.emd_weight=0", "optimizer.lr=0.02"),
        *(f"cache={folder}/cache", "val_fraction=0"),
    ]
    run(compose(overrides), folder / "run", overrides)
    return folder


def test_scene_sampler_with_attributes_takes_those_of_the_file(trained, tmp_path):
    source, options = trained / "scans" / "0.ply", ["--weights", trained / "run", "--m", 50]
    whole = read(source, 9, 0)
    inverse = Table(whole.points, {"red": 60_000 - whole.columns["red"]})
    WRITERS[".ply"](tmp_path / "inverse.ply", inverse)
    found = []
    for name in (source, tmp_path / "inverse.ply"):
        arguments = [name, tmp_path / "out.npz", *options, "--tile", 64, "--overwrite"]
        status, out, err = call(*arguments, "--keep-attributes")
        assert (status, err) == (0, "")
        assert "50 of 400 points" in out
        found.append(read(tmp_path / "out.npz", 9, 0))
    assert {tuple(one) for one in found[0].points} <= {tuple(one) for one in whole.points}
    assert not np.array_equal(found[0].points, found[1].points)
    np.testing.assert_array_equal(found[0].columns["red"] > 0, found[0].points[:, 1] > 0)


def test_scene_loaded_sampler_equals_command(trained, tmp_path):
    source = trained / "scans" / "1.ply"
    assert call(source, tmp_path / "out.npy", "--weights", trained / "run", "--m", 20)[0] == 0
    sampler = load(trained / "run")
    assert sampler.attributes == ("red",)
    table = read(source, 9, 0)
    points = np.column_stack([table.points, table.columns["red"]])
    chosen, rows = sampler.downsample(points, 20)
    np.testing.assert_array_equal(chosen, points[rows])
    assert {tuple(p) for p in chosen[:, :3]} == {tuple(p) for p in np.load(tmp_path / "out.npy")}


def test_scene_attribute_missing_or_in_chunks_raises(trained, scan, tmp_path):
    options = ["--weights", trained / "run", "--m", 50, "--tile", 64]
    status, _, err = call(scan, tmp_path / "out.ply", *options)
    assert status == 2
    assert re.search(r"scan\.ply has no attribute 'red'.*it has label", err)
    status, _, err = call(trained / "scans/0.ply", tmp_path / "out.ply", *options, "--chunk", 90)
    assert status == 2
    assert re.search(r"--chunk: .* takes attributes \(red\)", err)
