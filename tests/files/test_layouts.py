"""``--columns`` and ``--vertices`` on the command line."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning.data.formats.registry import read
from mops_lightning.files.cli import propagate
from tests.support.captured import done
from tests.support.cloud_files import contents
from tests.support.downsample import done as downsampled
from tests.support.downsample import refused

SIX_COLUMNS = ["--columns", "x,y,z,r,g,b"]


@pytest.fixture
def six_columns(tmp_path):
    """A .bin file of 60 points with six columns, and its rows."""
    path = tmp_path / "a.bin"
    random = np.random.default_rng(0)
    rows = random.random((60, 6), np.float32)
    rows.tofile(path)
    return path, rows


def in_any_order(rows):
    return sorted(rows.tolist())


def test_downsample_columns_names_those_of_a_bin_file(six_columns, tmp_path):
    path, rows = six_columns
    out = tmp_path / "b.npy"

    downsampled(path, out, "--method", "fps", "--m", 60, *SIX_COLUMNS)

    kept = np.load(out)
    assert in_any_order(kept) == in_any_order(rows)


def test_downsample_columns_of_another_format_is_refused(tmp_path):
    source = tmp_path / "a.npy"
    np.save(source, np.ones((9, 3)))
    arguments = ["--method", "fps", "--m", 3, "--columns", "x,y,z"]

    said = refused(source, tmp_path / "b.npy", *arguments)

    assert "--columns is for .bin files" in said


def test_downsample_columns_names_those_of_a_bin_file_in_chunks(six_columns, tmp_path):
    path, rows = six_columns
    out = tmp_path / "c.bin"

    downsampled(path, out, "--method", "fps", "--m", 60, *SIX_COLUMNS, "--chunk", 60)

    kept = np.fromfile(out, "<f4").reshape(-1, 6)
    assert in_any_order(kept) == in_any_order(rows)


def test_propagate_columns_names_those_of_a_bin_file(six_columns, tmp_path):
    path, rows = six_columns
    small = tmp_path / "small.npz"
    first_point = rows[:1, :3]
    np.savez(small, points=first_point, label=[7])

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

    downsampled(path, out, "--method", "fps", "--m", 50, "--vertices")

    kept = np.load(out)[:, :3]
    vertices = read(path, 9, 0, vertices=True).points
    assert len(kept) == 50
    assert as_set(kept) <= as_set(vertices)
    assert_allclose(vertices, ball.vertices, atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "points"),
    [
        (["--m", 5, "--surface", 60], "5 of 60 points"),
        (["--m", 5], "5 of 10,000 points"),
        (["--m", 1300], "1,300 of 10,400 points"),
        (["--m", "1%"], "100 of 10,000 points"),
        (["--spacing", 99], "1 of 10,000 points"),
        (["--spacing", 99, "--surface", 60], "1 of 60 points"),
    ],
)
def test_downsample_takes_points_on_the_surface_of_a_mesh(settings, points, tmp_path):
    path = tmp_path / "a.off"
    trimesh.creation.box().export(path)
    if "--m" in settings:
        settings = [*settings, "--method", "random"]

    out = downsampled(path, tmp_path / "b.npy", *settings)

    assert f"b.npy: {points}, " in out
    kept = np.load(tmp_path / "b.npy")[:, :3]
    assert_allclose(np.abs(kept).max(1), 0.5, atol=1e-6)


def test_downsample_of_a_mesh_takes_other_points_of_its_surface_by_seed(tmp_path):
    path = tmp_path / "a.off"
    trimesh.creation.box().export(path)

    def sampled(name, seed):
        out = tmp_path / name
        downsampled(path, out, "--spacing", 0.9, "--seed", seed)
        return np.load(out).tolist()

    first = sampled("first.npy", 3)
    assert sampled("again.npy", 3) == first
    assert sampled("other.npy", 4) != first


def test_downsample_vertices_of_a_sampled_surface_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.export(path)
    vertices = ["--method", "fps", "--m", 50, "--vertices"]

    said = refused(path, tmp_path / "c.npy", *vertices, "--surface", 60)

    assert "leave --surface out" in said
