"""``--columns`` and ``--vertices`` on the command line."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning.data.formats.registry import read
from mops_lightning.files.cli import propagate
from tests.support.captured import done
from tests.support.cloud_files import contents
from tests.support.downsample import call, refused

SIX_COLUMNS = ["--columns", "x,y,z,r,g,b"]


@pytest.fixture
def six_columns(tmp_path):
    """A .bin file of 60 points with six columns, and its rows."""
    path = tmp_path / "a.bin"
    rows = np.random.default_rng(0).normal(size=(60, 6)).astype(np.float32)
    rows.tofile(path)
    return path, rows


def test_downsample_columns_names_those_of_a_bin_file(six_columns, tmp_path):
    path, rows = six_columns
    out = tmp_path / "b.npy"

    status, _, err = call(path, out, "--method", "fps", "--m", 60, *SIX_COLUMNS)

    assert status == 0
    assert err == ""
    kept = np.load(out)
    assert sorted(kept.tolist()) == sorted(rows.tolist())


def test_downsample_columns_of_another_format_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((9, 3)))
    arguments = ["--method", "fps", "--m", 3, "--columns", "x,y,z"]

    said = refused(tmp_path / "a.npy", tmp_path / "b.npy", *arguments)

    assert "--columns is for .bin files" in said


def test_downsample_columns_names_those_of_a_bin_file_in_chunks(six_columns, tmp_path):
    path, rows = six_columns
    out = tmp_path / "c.bin"

    status, _, _ = call(path, out, "--method", "fps", "--m", 60, *SIX_COLUMNS, "--chunk", 60)

    assert status == 0
    kept = np.fromfile(out, "<f4").reshape(-1, 6)
    assert sorted(kept.tolist()) == sorted(rows.tolist())


def test_propagate_columns_names_those_of_a_bin_file(six_columns, tmp_path):
    path, rows = six_columns
    small = tmp_path / "small.npz"
    np.savez(small, points=rows[:1, :3], label=[7])

    done(propagate, [small, path, "--field", "label", *SIX_COLUMNS])

    made = contents(tmp_path / "a_propagated.ply")
    assert_array_equal(made.columns["b"], rows[:, 5])
    assert made.columns["label"].tolist() == [7] * 60


def as_set(points):
    return {tuple(point) for point in points}


@pytest.mark.parametrize("suffix", [".ply", ".off"])
def test_downsample_vertices_takes_those_of_a_mesh(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    out = tmp_path / "b.npy"
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.export(path)

    status, _, _ = call(path, out, "--method", "fps", "--m", 50, "--vertices")

    assert status == 0
    kept = np.load(out)[:, :3]
    vertices = read(path, 9, 0, vertices=True).points
    assert len(kept) == 50
    assert as_set(kept) <= as_set(vertices)
    assert_allclose(vertices, ball.vertices, atol=1e-6)


def test_downsample_vertices_of_a_sampled_surface_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    trimesh.creation.icosphere(subdivisions=2).export(path)
    vertices = ["--method", "fps", "--m", 50, "--vertices"]

    said = refused(path, tmp_path / "c.npy", *vertices, "--surface", 60)

    assert "leave --surface out" in said
