"""Files that a sampler with local columns downsamples: whole, by tiles and in chunks."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning import load
from tests.support.cloud_files import contents
from tests.support.clouds import normal_points
from tests.support.downsample import done


@pytest.fixture
def scan(tmp_path):
    """A cloud of 3,000 points in map coordinates."""
    path = tmp_path / "scan.npy"
    unit = normal_points(3000, 1)
    points = unit * [50, 20, 3] + np.array([4e5, 5e6, 80])
    np.save(path, points)
    return path


@pytest.mark.parametrize("readout", ["generated", "matched", "completed"])
def test_local_columns_of_a_file_equal_those_of_the_cloud(readout, local, scan, tmp_path):
    out = tmp_path / "out.npy"

    done(scan, out, "--weights", local, "--readout", readout, "--m", 30)

    expected, _ = load(str(local)).downsample(np.load(scan), 30, readout)
    assert_allclose(np.load(out), expected, rtol=0, atol=1e-4)


def test_local_columns_of_a_chunk_with_all_points_equal_those_of_the_file(local, scan, tmp_path):
    settings = ["--weights", local, "--m", 30]
    done(scan, tmp_path / "whole.npy", *settings)

    done(scan, tmp_path / "chunk.npy", *settings, "--chunk", 3000)

    assert_array_equal(np.load(tmp_path / "chunk.npy"), np.load(tmp_path / "whole.npy"))


def as_set(points):
    return {tuple(point) for point in points}


def test_local_columns_of_tiles_keep_different_points_of_every_tile(local, scan, tmp_path):
    out = tmp_path / "out.npy"

    done(scan, out, "--weights", local, "--m", 600, "--tile", 150)

    points = np.load(scan)
    kept = np.load(out)
    assert len(as_set(kept) & as_set(points)) == 600
    # Each of 20 tiles keeps 30 points on average.
    middle = np.median(points[:, 0])
    in_left_half = kept[:, 0] < middle
    assert in_left_half.sum() == pytest.approx(300, abs=40)


@pytest.mark.parametrize(
    ("readout", "tolerance"),
    [
        ("generated", 1e-4),  # rounded to float32 in the unit sphere
        ("matched", 0.0),
    ],
)
def test_local_columns_in_chunks_equal_those_of_the_whole_file(
    readout, tolerance, local, scan, tmp_path
):
    whole = tmp_path / "whole.npy"
    chunks = tmp_path / "chunks.npy"
    settings = ["--weights", local, "--m", 30, "--readout", readout]
    done(scan, whole, *settings)

    line = done(scan, chunks, *settings, "--chunk", 700)

    assert "30 of 3,000 points" in line
    assert "random" not in line
    assert_allclose(np.load(chunks), np.load(whole), rtol=0, atol=tolerance)


def test_completed_points_of_local_columns_come_from_a_chunk_of_random_points(
    local, scan, tmp_path
):
    settings = ["--weights", local, "--m", 30, "--chunk", 1000]

    assert "random (--chunk)" in done(scan, tmp_path / "out.npy", *settings)

    assert len(contents(tmp_path / "out.npy").points) == 30
