"""Mistakes on the command line of the subcommand ``propagate``."""

import numpy as np
import pytest
import trimesh

from mops_lightning.files.cli import propagate as main
from tests.support.captured import refused
from tests.support.cloud_files import write_cloud
from tests.support.clouds import line_of

FIELD = ["--field", "label"]


@pytest.fixture
def folder_of_mistakes(tmp_path, monkeypatch):
    """A folder with clouds, meshes and an old result, which is the current one."""
    monkeypatch.chdir(tmp_path)
    line = line_of(5)
    write_cloud(tmp_path / "big.npz", line)
    write_cloud(tmp_path / "small.npz", line[:3], {"label": np.arange(3)})
    write_cloud(tmp_path / "empty.npz", line[:0])
    (tmp_path / "old.ply").touch()
    trimesh.creation.box().export(tmp_path / "mesh.ply")
    trimesh.creation.box().export(tmp_path / "mesh.off")
    return tmp_path


@pytest.mark.parametrize(
    ("files", "said"),
    [
        (["small.npz", "big.npz", "out.obj"], "OUT must end in .ply, .las, .laz, .copc.laz, got"),
        (["small.npz", "mesh.ply", "mesh.ply"], "OUT must differ"),
        (["small.npz", "big.npz", "old.ply"], "old.ply exists"),
        (["small.npz", "nowhere.ply"], "nowhere.ply: no such file"),
        (["nowhere.ply", "big.npz"], "nowhere.ply: no such file"),
        (["small.npz", "empty.npz"], "must be a cloud of at least one point"),
        (["small.npz", "mesh.ply"], "must be a cloud of at least one point"),
        (["small.npz", "mesh.off", "out.ply"], "mesh.off must end in .ply"),
        (["small.npz", "."], ".: not a file"),
        (["small.npz", ""], ".: not a file"),
        (["small.npz", "/"], "/: not a file"),
    ],
)
def test_wrong_file_ends_in_one_line(files, said, folder_of_mistakes):
    before = sorted(folder_of_mistakes.iterdir())

    assert said in refused(main, [*files, *FIELD])

    assert sorted(folder_of_mistakes.iterdir()) == before


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["--field", "lable"], "no column 'lable'. Did you mean 'label'?"),
        (["--field", "label", "--k", 4], "--k must be from 1 to the 3"),
    ],
)
def test_wrong_setting_ends_in_one_line(settings, said, folder_of_mistakes):
    before = sorted(folder_of_mistakes.iterdir())

    assert said in refused(main, ["small.npz", "big.npz", *settings])

    assert sorted(folder_of_mistakes.iterdir()) == before
