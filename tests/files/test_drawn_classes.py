"""Points drawn by class and in chunks, and refusals with their reasons."""

from collections import Counter

import numpy as np
import pytest

from mops_lightning.filesystem import TEMPORARY
from tests.support.cloud_files import contents, write_cloud
from tests.support.clouds import normal_points
from tests.support.downsample import done, refused


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    """A file of 600 points: 2 of class 9, 118 of class 4 and 480 of class 1."""
    path = tmp_path_factory.mktemp("classes") / "a.ply"
    classes = np.ones(600, np.uint8)
    classes[:2] = 9
    classes[2:120] = 4
    rows = np.arange(600, dtype=np.int32)
    write_cloud(path, normal_points(600, 0), {"classification": classes, "row": rows})
    return path


def classes_of(path):
    return dict(Counter(contents(path).columns["classification"].tolist()))


def test_chunk_of_all_points_draws_none(cloud, tmp_path):
    options = ["--method", "random", "--m", 60, "--chunk"]

    of_all = done(cloud, tmp_path / "all.ply", *options, 600)
    of_few = done(cloud, tmp_path / "few.ply", *options, 599)

    assert "60 of 600 points, " in of_all
    assert "chosen among" not in of_all
    assert "chosen among 599 that were drawn at random (--chunk)" in of_few


@pytest.mark.parametrize("extra", [[], ["--chunk", 900]])
def test_stratify_keeps_the_order_of_the_file(extra, cloud, tmp_path):
    options = ["--method", "random", "--m", 60, "--stratify", "class:min=20", *extra]

    done(cloud, tmp_path / "out.ply", *options)

    kept = contents(tmp_path / "out.ply")
    rows = kept.columns["row"].tolist()
    assert rows == sorted(rows)
    assert classes_of(tmp_path / "out.ply") == {1: 38, 4: 20, 9: 2}


def test_stratify_with_a_chunk_of_m_draws_as_many_of_every_class_as_it_keeps(cloud, tmp_path):
    options = ["--method", "random", "--m", 60, "--stratify", "class:min=20", "--chunk", 60]

    done(cloud, tmp_path / "out.ply", *options)

    assert classes_of(tmp_path / "out.ply") == {1: 38, 4: 20, 9: 2}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--m", "50%", "--chunk", 100], "--chunk must be at least --m 300, got 100"),
        (
            ["--m", "50%", "--chunk", 100, "--stratify", "class:share"],
            "--chunk must be at least --m 300, got 100",
        ),
        (
            ["--m", 601, "--chunk", 900, "--stratify", "class:share"],
            "holds 600 points, fewer than --m 601",
        ),
        (["--m", 601, "--chunk", 900], "holds 600 points, fewer than --m 601"),
    ],
)
def test_more_points_than_are_drawn_are_refused(options, said, cloud, tmp_path):
    words = refused(cloud, tmp_path / "out.ply", "--method", "random", *options)

    assert said in words


@pytest.mark.parametrize("method", ["fps", "poisson"])
def test_space_of_columns_too_large_for_distances_is_refused(method, tmp_path):
    source = tmp_path / "in.ply"
    write_cloud(source, normal_points(20, 0), {"heat": np.full(20, 1e200)})
    options = ["--method", method, "--m", 5, "--space", "heat"]

    words = refused(source, tmp_path / "out.ply", *options)

    assert "its coordinates are too large for float64 distances" in words


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--m", "10%"], "a share needs"),
        (["--m", 16, "--stratify", "class:share"], "classes need"),
        (["--m", 16, "--tile", 64], "tiles need"),
        (["--m", "10%", "--tile", 64], "tiles need"),
    ],
)
def test_sampler_of_one_size_is_refused_with_the_reason(options, reason, cloud, tmp_path):
    weights = ["--weights", "mops.modelnet40-m16-seed0"]

    words = refused(cloud, tmp_path / "out.ply", *weights, *options)

    assert f"--weights: {reason} a sampler of every size, such as FMOPS-Net" in words
    assert "mops.modelnet40-m16-seed0 is a MOPSNet for 16 points" in words


def test_what_a_killed_run_left_beside_the_output_is_removed(cloud, tmp_path):
    left = tmp_path / f"{TEMPORARY}out-x.ply"
    below = tmp_path / "below" / f"{TEMPORARY}out-x.ply"
    below.parent.mkdir()
    for path in (left, below):
        path.write_bytes(b"half")

    done(cloud, tmp_path / "out.ply", "--method", "random", "--m", 5)

    assert not left.exists()
    assert below.exists()  # of another folder, where another run may write
