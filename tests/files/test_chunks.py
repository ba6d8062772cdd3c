"""Files that are read in chunks."""

import numpy as np
import pytest

from mops_lightning.data.formats.registry import WRITERS, read
from mops_lightning.data.formats.table import Table
from mops_lightning.files import chunks
from tests.support.downsample import call, done, refused


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".bin", ".laz"])
@pytest.mark.parametrize("readout", ["generated", "matched"])
def test_chunks_equal_whole_file(suffix, readout, folder, tmp_path):
    points = np.random.default_rng(1).normal(size=(500, 3)).astype(np.float32).astype(float)
    points[200:] = points[np.arange(300) % 100]  # of equal points, the first one is matched
    if suffix != ".laz":  # it holds whole numbers, NaN is none
        points[100:160] = np.nan
    source = tmp_path / f"in{suffix}"
    WRITERS[suffix](source, Table(points, {"intensity": np.arange(500, dtype=np.uint16)}))
    settings = ["--weights", folder, "--readout", readout]
    assert call(source, tmp_path / "whole.npz", *settings)[0] == 0
    out = done(source, tmp_path / "parts.npz", *settings, "--chunk", 60)
    assert ("40 of 500 points" if suffix == ".laz" else "40 of 440 points (60 more") in out
    whole, parts = (read(tmp_path / f"{name}.npz", 9, 0) for name in ("whole", "parts"))
    np.testing.assert_allclose(parts.points, whole.points, atol=1e-5)
    assert list(parts.columns) == list(whole.columns)
    for name, column in whole.columns.items():
        np.testing.assert_array_equal(parts.columns[name], column)


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
    points = np.random.default_rng(1).normal(size=(500, 3))
    points[100:160] = np.nan
    finite = np.delete(np.arange(500), slice(100, 160))
    parts = [finite[finite // 120 == place] for place in range(5)]
    keys = [np.random.default_rng([3, 120 * i]).random(len(part)) for i, part in enumerate(parts)]
    drawn = np.sort(np.concatenate(parts)[np.concatenate(keys).argsort()[:200]])
    np.save(tmp_path / "all.npy", np.column_stack([points, np.arange(500)]))
    np.save(tmp_path / "drawn.npy", np.column_stack([points, np.arange(500)])[drawn])
    settings = [folder if one == "FOLDER" else one for one in settings]
    settings += ["--m", 30, "--seed", 3]
    assert call(tmp_path / "drawn.npy", tmp_path / "want.npy", *settings)[0] == 0
    status, out, _ = call(tmp_path / "all.npy", tmp_path / "out.npy", *settings, "--chunk", 200)
    assert (status, "30 of 440 points (60 more without" in out) == (0, True)
    np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), np.load(tmp_path / "want.npy"))


def test_bounds_hold_for_chunks_and_whole_files(folder, tmp_path):
    points = np.random.default_rng(1).normal(size=(500, 3))
    np.save(tmp_path / "all.npy", points)
    part = points[(np.abs(points[:, :2]) <= 1).all(1)]
    np.save(tmp_path / "part.npy", part)
    settings = ["--weights", folder, "--readout", "matched", "--m", 30]
    assert call(tmp_path / "part.npy", tmp_path / "want.npy", *settings)[0] == 0
    for more in ([], ["--chunk", 60]):
        bounds = ["--bounds", "-1,-1,1,1", "--overwrite"]
        status, out, _ = call(tmp_path / "all.npy", tmp_path / "out.npy", *settings, *bounds, *more)
        assert (status, f"30 of {len(part)} points, " in out) == (0, True)
        np.testing.assert_array_equal(np.load(tmp_path / "out.npy"), np.load(tmp_path / "want.npy"))


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
    path = tmp_path / "a.npy"
    np.save(path, np.random.default_rng(1).normal(size=(90, 3)))
    settings = ["--weights", anchored, "--readout", "matched", "--m", 20]
    assert call(path, tmp_path / "out.npy", *settings)[0] == 0
    assert np.load(tmp_path / "out.npy").shape == (20, 3)
    assert "anchors=fps" in refused(path, tmp_path / "none.npy", *settings, "--chunk", 60)
