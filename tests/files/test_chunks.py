"""Files that are read in chunks."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning.files import chunks
from tests.support.cloud_files import contents, write_cloud
from tests.support.clouds import normal_points
from tests.support.downsample import call, done, refused


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".bin", ".laz"])
@pytest.mark.parametrize("readout", ["generated", "matched"])
def test_chunks_equal_whole_file(suffix, readout, folder, tmp_path):
    source = tmp_path / f"in{suffix}"
    points = normal_points(500, 1).astype(np.float32).astype(float)
    points[200:] = np.tile(points[:100], (3, 1))  # of equal points, the first one is matched
    number = "40 of 500 points"
    if suffix != ".laz":  # it holds whole numbers, NaN is none
        points[100:160] = np.nan
        number = "40 of 440 points (60 more"
    intensity = np.arange(500, dtype=np.uint16)
    write_cloud(source, points, {"intensity": intensity})
    settings = ["--weights", folder, "--readout", readout]

    done(source, tmp_path / "whole.npz", *settings)
    out = done(source, tmp_path / "parts.npz", *settings, "--chunk", 60)

    assert number in out
    whole = contents(tmp_path / "whole.npz")
    parts = contents(tmp_path / "parts.npz")
    assert_allclose(parts.points, whole.points, atol=1e-5)
    assert list(parts.columns) == list(whole.columns)
    for name, column in whole.columns.items():
        assert_array_equal(parts.columns[name], column)


def drawn_by_parts(rows, number, seed):
    """Return the rows with the smallest keys, which are drawn for each part of 120 rows."""
    keys = []
    for start in range(0, 500, 120):
        of_part = (rows >= start) & (rows < start + 120)
        rng = np.random.default_rng([seed, start])
        keys.append(rng.random(of_part.sum()))
    smallest = np.concatenate(keys).argsort()[:number]
    return np.sort(rows[smallest])


@pytest.mark.parametrize(
    "settings",
    [
        ["--method", "voxel"],
        ["--method", "serial"],
        ["--weights", "FOLDER", "--readout", "completed"],
        ["--weights", "FOLDER", "--tile", 64],
    ],
)
def test_other_methods_sample_random_points_of_all_parts(settings, folder, tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, "PART", 120)
    points = normal_points(500, 1)
    points[100:160] = np.nan
    finite = np.delete(np.arange(500), slice(100, 160))
    drawn = drawn_by_parts(finite, 200, seed=3)
    numbered = np.column_stack([points, np.arange(500)])
    np.save(tmp_path / "all.npy", numbered)
    np.save(tmp_path / "drawn.npy", numbered[drawn])
    settings = [folder if value == "FOLDER" else value for value in settings]
    settings += ["--m", 30, "--seed", 3]
    done(tmp_path / "drawn.npy", tmp_path / "expected.npy", *settings)

    status, out, _ = call(tmp_path / "all.npy", tmp_path / "out.npy", *settings, "--chunk", 200)

    assert status == 0
    assert "30 of 440 points (60 more without" in out
    kept = np.load(tmp_path / "out.npy")
    expected = np.load(tmp_path / "expected.npy")
    assert_array_equal(kept, expected)


@pytest.mark.parametrize("chunk", [[], ["--chunk", 60]])
def test_bounds_hold_for_chunks_and_whole_files(chunk, folder, tmp_path):
    points = normal_points(500, 1)
    is_inside = (np.abs(points[:, :2]) <= 1).all(1)
    np.save(tmp_path / "all.npy", points)
    np.save(tmp_path / "part.npy", points[is_inside])
    settings = ["--weights", folder, "--readout", "matched", "--m", 30]
    bounds = ["--bounds", "-1,-1,1,1"]
    done(tmp_path / "part.npy", tmp_path / "expected.npy", *settings)

    status, out, _ = call(tmp_path / "all.npy", tmp_path / "out.npy", *settings, *bounds, *chunk)

    assert status == 0
    assert f"30 of {is_inside.sum()} points, " in out
    kept = np.load(tmp_path / "out.npy")
    expected = np.load(tmp_path / "expected.npy")
    assert_array_equal(kept, expected)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.xyz", b"1 2 3", "--chunk works with .npy"),
        ("a.bin", b"123", "3 bytes are not rows of 4 float32"),
        ("a.npy", b"123", "a.npy is broken"),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n", "does not end"),
        ("a.ply", b"\n" * 10_000, "does not end"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 9\nend_header\n", "needs binary PLY"),
    ],
)
def test_unsupported_file_says_why(name, content, said, folder, tmp_path):
    (tmp_path / name).write_bytes(content)
    settings = ["--weights", folder, "--readout", "matched", "--chunk", 60]
    assert said in refused(tmp_path / name, tmp_path / "out.ply", *settings)


def test_sampler_with_anchors_takes_whole_files_only(anchored, tmp_path):
    source = tmp_path / "a.npy"
    points = normal_points(90, 1)
    np.save(source, points)
    settings = ["--weights", anchored, "--readout", "matched", "--m", 20]

    done(source, tmp_path / "out.npy", *settings)
    words = refused(source, tmp_path / "none.npy", *settings, "--chunk", 60)

    assert np.load(tmp_path / "out.npy").shape == (20, 3)
    assert "anchors=fps" in words
