"""Shares, totals and classes; and commands that were killed between the map and the output."""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from tests.support.cloud_files import contents, write_cloud
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
        write_cloud(folder / f"{name}.ply", points, columns)
    (folder / "notes.md").write_text("two files of other kinds\n")
    (folder / "scan.xyzzy").write_text("1 2 3\n")
    return folder


def number_of_points(path):
    return len(contents(path).points)


def sizes_of(folder):
    """Return the number of points of every PLY file of a folder."""
    sizes = {}
    for path in folder.glob("*.ply"):
        sizes[path.stem] = number_of_points(path)
    return sizes


def write_normal(path, number):
    write_cloud(path, RNG.normal(size=(number, 3)))


def classes_of(path):
    return dict(Counter(contents(path).columns["classification"].tolist()))


@pytest.mark.parametrize("chunk", [[], ["--chunk", 200]])
@pytest.mark.parametrize(
    ("share", "number"),
    [
        ("10%", 60),
        ("12.5%", 75),
        ("0.25%", 2),
        ("0.01%", 1),
    ],
)
def test_share_of_a_file(share, number, chunk, clouds, tmp_path):
    small = tmp_path / "out.ply"

    out = done(clouds / "a.ply", small, "--method", "fps", "--m", share, *chunk)

    assert f"{number} of 600 points" in out
    assert number_of_points(small) == number
    says_chunk = "chosen among 200 that were drawn at random (--chunk)" in out
    assert says_chunk == bool(chunk)


@pytest.mark.parametrize("workers", [1, 2])
def test_share_of_each_file_of_a_folder(workers, clouds, tmp_path):
    out = done(clouds, tmp_path, "--method", "random", "--m", "10%", "--workers", workers)

    assert sizes_of(tmp_path) == {"a": 60, "b": 30, "c": 10}
    assert "5 files: 3 done, 2 skipped: .md .xyzzy; in" in out


@pytest.mark.parametrize("m", ["50", "5%"])
def test_total_of_a_folder(m, clouds, tmp_path):
    done(clouds, tmp_path, "--method", "random", "--m", m, "--total")

    assert sizes_of(tmp_path) == {"a": 30, "b": 15, "c": 5}


@pytest.mark.parametrize(
    ("m", "sizes"),
    [
        (3, {"a": 1, "b": 1, "c": 1}),
        (5, {"a": 3, "b": 1, "c": 1}),
        (94, {"a": 90, "b": 2, "c": 2}),
    ],
)
def test_total_keeps_a_point_of_every_file(m, sizes, tmp_path):
    source = tmp_path / "in"
    out = tmp_path / "out"
    source.mkdir()
    write_normal(source / "a.ply", 90)
    write_normal(source / "b.ply", 2)
    write_normal(source / "c.ply", 2)

    done(source, out, "--method", "random", "--m", m, "--total")

    assert sizes_of(out) == sizes


def test_total_of_the_rest_of_a_folder_is_that_of_the_whole_folder(clouds, tmp_path):
    arguments = [clouds, tmp_path, "--method", "random", "--m", 50, "--total"]
    done(*arguments)
    (rest,) = tmp_path.glob("**/b.*")
    rest.unlink()

    out = done(*arguments)

    assert sizes_of(tmp_path) == {"a": 30, "b": 15, "c": 5}
    assert "1 done" in out


def test_total_lists_broken_files_and_goes_on(tmp_path):
    source = tmp_path / "in"
    result = tmp_path / "out"
    source.mkdir()
    write_normal(source / "a.ply", 60)
    write_normal(source / "b.ply", 30)
    (source / "broken.laz").write_bytes(b"LASF and nothing else")
    (source / "empty.xyz").write_text("")

    status, out, err = call(source, result, "--method", "random", "--m", 9, "--total")

    assert sizes_of(result) == {"a": 6, "b": 3}
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
    small = tmp_path / "out.ply"

    done(
        clouds / "a.ply",
        small,
        "--method",
        "fps",
        "--m",
        60,
        "--stratify",
        "class:share",
        *extra,
    )

    counts = classes_of(small)
    without_the_rarest = {1: 48, 4: 12}
    with_the_rarest = {1: 48, 4: 11, 9: 1}
    assert counts in (without_the_rarest, with_the_rarest)


@pytest.mark.parametrize("extra", [[], ["--chunk", 300], ["--tile", 64]])
def test_stratify_least(extra, clouds, tmp_path):
    options = ["--method", "fps", "--m", 60, "--stratify", "class:min=20", *extra]
    done(clouds / "a.ply", tmp_path / "out.ply", *options)

    assert classes_of(tmp_path / "out.ply") == {1: 38, 4: 20, 9: 2}


def test_stratify_with_chunk_draws_a_class_from_all_of_the_file(clouds, tmp_path):
    options = ["--method", "random", "--m", 60, "--stratify", "class:share", "--chunk", 60]
    done(clouds / "a.ply", tmp_path / "out.ply", *options)

    kept = contents(tmp_path / "out.ply")
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
    small = tmp_path / "out.ply"

    done(clouds / "a.ply", small, "--method", method, "--m", 2, "--space", "row")

    first, second = contents(small).columns["row"].tolist()
    assert abs(first - second) >= 290


@pytest.mark.parametrize("method", ["fps", "poisson"])
@pytest.mark.parametrize("extra", [["--seed", 3], ["--weight", "row"]])
def test_space_of_the_coordinates_alone_keeps_the_points_of_no_space(
    extra, method, clouds, tmp_path
):
    settings = ["--method", method, "--m", 20, *extra]

    done(clouds / "c.ply", tmp_path / "plain.ply", *settings)
    done(clouds / "c.ply", tmp_path / "in_space.ply", *settings, "--space", "x")

    plain = contents(tmp_path / "plain.ply").columns["row"].tolist()
    assert contents(tmp_path / "in_space.ply").columns["row"].tolist() == plain


def test_space_with_another_column_keeps_all_coordinates(tmp_path):
    source = tmp_path / "in.ply"
    small = tmp_path / "out.ply"
    height = np.arange(100)
    upright = np.zeros((100, 3))
    upright[:, 2] = height
    grey = np.resize([0, 1], 100).astype(np.uint8)
    write_cloud(source, upright, {"grey": grey})

    done(source, small, "--method", "fps", "--m", 9, "--space", "grey=0.01")

    kept = contents(small).points
    to_kept = np.abs(height[:, None] - kept[:, 2])
    assert to_kept.min(axis=1).max() <= 100 / 8


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
