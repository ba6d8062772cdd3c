"""Shares, totals and classes; and commands that were killed between the map and the output."""

from typing import Any

import numpy as np
import pytest

from mops_lightning.data.formats.registry import WRITERS, read
from mops_lightning.data.formats.table import Table
from tests.support.downsample import call, done, refused

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    """A folder of clouds of 600, 300 and 100 points with classes, and two files of other kinds."""
    folder = tmp_path_factory.mktemp("clouds") / "in"
    folder.mkdir()
    for name, number in (("a", 600), ("b", 300), ("c", 100)):
        classes = np.ones(number, np.uint8)
        classes[:2] = 9
        classes[2 : number // 5] = 4
        points = RNG.normal(size=(number, 3))
        columns: dict[str, Any] = {
            "classification": classes,
            "row": np.arange(number, dtype=np.int32),
        }
        WRITERS[".ply"](folder / f"{name}.ply", Table(points, columns))
    (folder / "notes.md").write_text("two files of other kinds\n")
    (folder / "scan.xyzzy").write_text("1 2 3\n")
    return folder


def classes_of(path):
    names, counts = np.unique(read(path, 9, 0).columns["classification"], return_counts=True)
    return dict(zip(names.tolist(), counts.tolist(), strict=True))


@pytest.mark.parametrize("chunk", [[], ["--chunk", 200]])
@pytest.mark.parametrize(
    ("share", "number"), [("10%", 60), ("12.5%", 75), ("0.25%", 2), ("0.01%", 1)]
)
def test_share_of_a_file(share, number, chunk, clouds, tmp_path):
    out = done(clouds / "a.ply", tmp_path / "out.ply", "--method", "fps", "--m", share, *chunk)

    assert f"{number} of 600 points" in out
    assert len(read(tmp_path / "out.ply", 9, 0).points) == number
    assert ("chosen among 200 that were drawn at random (--chunk)" in out) == bool(chunk)


@pytest.mark.parametrize("workers", [1, 2])
def test_share_of_each_file_of_a_folder(workers, clouds, tmp_path):
    out = done(clouds, tmp_path, "--method", "random", "--m", "10%", "--workers", workers)

    sizes = {path.stem: len(read(path, 9, 0).points) for path in tmp_path.glob("*.ply")}
    assert sizes == {"a": 60, "b": 30, "c": 10}
    assert "5 files: 3 done, 2 skipped: .md .xyzzy; in" in out


@pytest.mark.parametrize("m", ["50", "5%"])
def test_total_of_a_folder(m, clouds, tmp_path):
    done(clouds, tmp_path, "--method", "random", "--m", m, "--total")

    sizes = {path.stem: len(read(path, 9, 0).points) for path in tmp_path.glob("*.ply")}
    assert sizes == {"a": 30, "b": 15, "c": 5}


@pytest.mark.parametrize(("m", "numbers"), [(3, [1, 1, 1]), (5, [3, 1, 1]), (94, [90, 2, 2])])
def test_total_keeps_a_point_of_every_file(m, numbers, tmp_path):
    (tmp_path / "in").mkdir()
    for name, number in (("a", 90), ("b", 2), ("c", 2)):
        WRITERS[".ply"](tmp_path / "in" / f"{name}.ply", Table(RNG.normal(size=(number, 3))))

    done(tmp_path / "in", tmp_path / "out", "--method", "random", "--m", m, "--total")

    sizes = [len(read(tmp_path / "out" / f"{name}.ply", 9, 0).points) for name in "abc"]
    assert sizes == numbers


def test_total_lists_broken_files_and_goes_on(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for name, number in (("a", 60), ("b", 30)):
        WRITERS[".ply"](folder / f"{name}.ply", Table(RNG.normal(size=(number, 3))))
    (folder / "broken.laz").write_bytes(b"LASF and nothing else")
    (folder / "empty.xyz").write_text("")

    status, out, err = call(folder, tmp_path / "out", "--method", "random", "--m", 9, "--total")

    sizes = [len(read(tmp_path / "out" / f"{name}.ply", 9, 0).points) for name in "ab"]
    assert sizes == [6, 3]
    assert status == 1
    assert "failed: " in err
    assert "broken.laz" in err
    assert "empty.xyz" in err
    assert "4 files: 2 failed, 2 done; in" in out


@pytest.mark.parametrize("m", [2, 1001])
def test_total_out_of_range_is_refused(m, clouds, tmp_path):
    words = refused(clouds, tmp_path / "out", "--method", "random", "--m", m, "--total")

    assert "--total: the 3 files hold 1,000 points; --m must be from one point per file" in words


@pytest.mark.parametrize("extra", [[], ["--chunk", 300], ["--tile", 64], ["--weight", "row"]])
def test_stratify_share(extra, clouds, tmp_path):
    options = ["--method", "fps", "--m", 60, "--stratify", "class:share", *extra]
    done(clouds / "a.ply", tmp_path / "out.ply", *options)

    assert classes_of(tmp_path / "out.ply") == {1: 48, 4: 12} or classes_of(
        tmp_path / "out.ply"
    ) == {1: 48, 4: 11, 9: 1}


@pytest.mark.parametrize("extra", [[], ["--chunk", 300], ["--tile", 64]])
def test_stratify_least(extra, clouds, tmp_path):
    options = ["--method", "fps", "--m", 60, "--stratify", "class:min=20", *extra]
    done(clouds / "a.ply", tmp_path / "out.ply", *options)

    assert classes_of(tmp_path / "out.ply") == {1: 38, 4: 20, 9: 2}


def test_stratify_with_chunk_draws_a_class_from_all_of_the_file(clouds, tmp_path):
    options = ["--method", "random", "--m", 60, "--stratify", "class:share", "--chunk", 60]
    done(clouds / "a.ply", tmp_path / "out.ply", *options)

    kept = read(tmp_path / "out.ply", 9, 0)
    rows = kept.columns["row"][kept.columns["classification"] == 1]  # of rows 120 to 599
    assert rows.min() < 180
    assert 320 < rows.mean() < 400
    assert rows.max() > 540


def test_stratify_with_chunk_chooses_among_as_many_points_as_the_chunk_has(clouds, tmp_path):
    options = ["--method", "fps", "--m", 60, "--stratify", "class:min=20", "--chunk", 300]

    out = done(clouds / "a.ply", tmp_path / "out.ply", *options)

    assert "60 of 600 points, chosen among 300 that were drawn at random (--chunk)" in out


def test_stratify_more_than_m_is_refused(clouds, tmp_path):
    options = ["--method", "fps", "--m", 30, "--stratify", "class:min=20"]

    words = refused(clouds / "a.ply", tmp_path / "out.ply", *options)

    assert "--stratify: 20 points of each of the 3 classes are 42, more than --m 30" in words


@pytest.mark.parametrize("method", ["fps", "poisson"])
def test_space_makes_a_column_count(method, clouds, tmp_path):
    options = ["--method", method, "--m", 2, "--space", "row"]
    done(clouds / "a.ply", tmp_path / "out.ply", *options)

    rows = read(tmp_path / "out.ply", 9, 0).columns["row"]
    assert abs(int(rows[0]) - int(rows[1])) >= 290


def test_space_with_another_column_keeps_all_coordinates(tmp_path):
    upright = np.zeros((100, 3))
    upright[:, 2] = np.arange(100)
    grey = np.resize([0, 1], 100).astype(np.uint8)
    WRITERS[".ply"](tmp_path / "in.ply", Table(upright, {"grey": grey}))

    options = ["--method", "fps", "--m", 9, "--space", "grey=0.01"]
    done(tmp_path / "in.ply", tmp_path / "out.ply", *options)

    kept = read(tmp_path / "out.ply", 9, 0).points
    apart = np.abs(upright[:, 2, None] - kept[:, 2])
    assert apart.min(axis=1).max() <= 100 / 8


def test_killed_between_map_and_output_the_same_command_goes_on(clouds, tmp_path):
    target, path = tmp_path / "out.ply", tmp_path / "map.npz"
    command = [clouds / "a.ply", target, "--method", "fps", "--m", 20, "--map", path]
    done(*command)
    first = target.read_bytes(), path.read_bytes()
    target.unlink()

    done(*command)

    assert (target.read_bytes(), path.read_bytes()) == first


def test_map_of_another_command_is_not_replaced(clouds, tmp_path):
    target, path = tmp_path / "out.ply", tmp_path / "map.npz"
    path.write_bytes(b"mine")
    command = [clouds / "a.ply", target, "--method", "fps", "--m", 20, "--map", path]

    assert "map.npz exists. Give another --map, or --overwrite." in refused(*command)

    assert path.read_bytes() == b"mine"
    assert not target.exists()
    done(*command, "--overwrite")
