"""Files that are read in chunks."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning.files import chunks
from tests.support.cloud_files import contents, write_cloud
from tests.support.clouds import normal_points
from tests.support.downsample import done, refused


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".bin", ".laz"])
@pytest.mark.parametrize("readout", ["generated", "matched"])
def test_chunks_equal_whole_file(suffix, readout, folder, tmp_path):
    source = tmp_path / f"in{suffix}"
    in_float32 = normal_points(500, 1).astype(np.float32)
    points = in_float32.astype(float)
    points[200:] = np.tile(points[:100], (3, 1))  # of equal points, the first one is matched
    number = "40 of 500 points"
    if suffix != ".laz":  # it holds whole numbers, NaN is none
        points[100:160] = np.nan
        number = "40 of 440 points (60 more"
    intensity = np.arange(500, dtype=np.uint16)
    write_cloud(source, points, {"intensity": intensity})
    in_whole = tmp_path / "whole.npz"
    in_parts = tmp_path / "parts.npz"
    settings = ["--weights", folder, "--readout", readout]

    done(source, in_whole, *settings)
    out = done(source, in_parts, *settings, "--chunk", 60)

    assert number in out
    whole = contents(in_whole)
    parts = contents(in_parts)
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
    row = np.arange(500)
    finite = np.delete(row, slice(100, 160))
    drawn = drawn_by_parts(finite, 200, seed=3)
    numbered = np.column_stack([points, row])
    in_all = tmp_path / "all.npy"
    in_drawn = tmp_path / "drawn.npy"
    of_all = tmp_path / "out.npy"
    of_drawn = tmp_path / "expected.npy"
    np.save(in_all, numbered)
    np.save(in_drawn, numbered[drawn])
    settings = [folder if value == "FOLDER" else value for value in settings]
    settings += ["--m", 30, "--seed", 3]

    done(in_drawn, of_drawn, *settings)
    out = done(in_all, of_all, *settings, "--chunk", 200)

    assert "30 of 440 points (60 more without" in out
    kept = np.load(of_all)
    expected = np.load(of_drawn)
    assert_array_equal(kept, expected)


@pytest.mark.parametrize("chunk", [[], ["--chunk", 60]])
def test_bounds_hold_for_chunks_and_whole_files(chunk, folder, tmp_path):
    points = normal_points(500, 1)
    distances = np.abs(points[:, :2])
    is_inside = distances.max(1) <= 1
    in_all = tmp_path / "all.npy"
    in_part = tmp_path / "part.npy"
    of_all = tmp_path / "out.npy"
    of_part = tmp_path / "expected.npy"
    np.save(in_all, points)
    np.save(in_part, points[is_inside])
    settings = ["--weights", folder, "--readout", "matched", "--m", 30]
    bounds = ["--bounds", "-1,-1,1,1"]

    done(in_part, of_part, *settings)
    out = done(in_all, of_all, *settings, *bounds, *chunk)

    number = is_inside.sum()
    assert f"30 of {number} points, " in out
    kept = np.load(of_all)
    expected = np.load(of_part)
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
    source = tmp_path / name
    source.write_bytes(content)
    settings = ["--weights", folder, "--readout", "matched", "--chunk", 60]

    line = refused(source, tmp_path / "out.ply", *settings)

    assert said in line


def test_sampler_with_anchors_takes_whole_files_only(anchored, tmp_path):
    source = tmp_path / "a.npy"
    points = normal_points(90, 1)
    np.save(source, points)
    settings = ["--weights", anchored, "--readout", "matched", "--m", 20]

    out = tmp_path / "out.npy"

    done(source, out, *settings)
    words = refused(source, tmp_path / "none.npy", *settings, "--chunk", 60)

    kept = np.load(out)
    assert kept.shape == (20, 3)
    assert "anchors=fps" in words


@pytest.mark.parametrize("readout", ["generated", "matched"])
def test_equal_points_in_chunks_give_this_point(readout, folder, tmp_path):
    source = tmp_path / "a.npy"
    out = tmp_path / "b.npy"
    np.save(source, np.full((90, 3), 7.0))
    settings = ["--weights", folder, "--readout", readout, "--m", 20]

    done(source, out, *settings, "--chunk", 40)

    assert_allclose(np.load(out), np.full((20, 3), 7.0), atol=1e-6)
