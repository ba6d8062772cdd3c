"""``--columns`` and ``--vertices`` on the command line."""

import numpy as np
import trimesh

from mops_lightning.data.formats.registry import read
from mops_lightning.files.cli import propagate
from tests.support.captured import done
from tests.support.downsample import call, refused


def test_downsample_columns_names_those_of_a_bin_file(tmp_path):
    rows = np.random.default_rng(0).normal(size=(60, 6)).astype(np.float32)
    rows.tofile(tmp_path / "a.bin")
    arguments = ["--method", "fps", "--m", 60, "--columns", "x,y,z,r,g,b"]

    status, _, err = call(tmp_path / "a.bin", tmp_path / "b.npy", *arguments)

    assert (status, err) == (0, "")
    kept = np.load(tmp_path / "b.npy")
    assert sorted(kept.tolist()) == sorted(rows.tolist())
    assert call(tmp_path / "a.bin", tmp_path / "c.bin", *arguments, "--chunk", 60)[0] == 0
    again = np.fromfile(tmp_path / "c.bin", "<f4").reshape(-1, 6)
    assert sorted(again.tolist()) == sorted(rows.tolist())


def test_downsample_columns_of_another_format_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((9, 3)))
    arguments = ["--method", "fps", "--m", 3, "--columns", "x,y,z"]

    said = refused(tmp_path / "a.npy", tmp_path / "b.npy", *arguments)

    assert "--columns is for .bin files" in said


def test_propagate_columns_names_those_of_a_bin_file(tmp_path):
    rows = np.random.default_rng(0).normal(size=(60, 6)).astype(np.float32)
    rows.tofile(tmp_path / "a.bin")
    np.savez(tmp_path / "small.npz", points=rows[:1, :3], label=[7])

    files = [tmp_path / "small.npz", tmp_path / "a.bin"]
    done(propagate, [*files, "--field", "label", "--columns", "x,y,z,r,g,b"])

    made = read(tmp_path / "a_propagated.ply", 9, 0)
    np.testing.assert_array_equal(made.columns["b"], rows[:, 5])
    assert made.columns["label"].tolist() == [7] * 60


def test_downsample_vertices_takes_those_of_a_mesh(tmp_path):
    box = trimesh.creation.icosphere(subdivisions=2)
    for suffix in (".ply", ".off"):
        box.export(tmp_path / f"a{suffix}")
        arguments = ["--method", "fps", "--m", 50, "--vertices"]

        assert call(tmp_path / f"a{suffix}", tmp_path / "b.npy", *arguments, "--overwrite")[0] == 0

        kept = np.load(tmp_path / "b.npy")[:, :3]
        vertices = read(tmp_path / f"a{suffix}", 9, 0, vertices=True).points
        assert len(kept) == 50
        assert {tuple(row) for row in kept} <= {tuple(row) for row in vertices}
        np.testing.assert_allclose(vertices, box.vertices, atol=1e-6)
    said = refused(tmp_path / "a.ply", tmp_path / "c.npy", *arguments, "--surface", 60)
    assert "leave --surface out" in said
