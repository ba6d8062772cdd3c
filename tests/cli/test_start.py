"""What a refused run leaves."""

from mops_lightning.training.run import claim
from tests.support.command_line import TINY, call


def listing(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_run_with_wrong_setting_leaves_nothing(tmp_path):
    status, _, err = call([*TINY, "sampler=fps", "m=0"], tmp_path)
    assert (status, err.count("\n")) == (2, 1)
    assert list(tmp_path.iterdir()) == []


def test_second_run_in_folder_writes_nothing(tmp_path):
    claim(tmp_path / "run")
    before = listing(tmp_path)
    status, _, err = call([*TINY, "sampler=fps", "hydra.run.dir=run"], tmp_path)
    assert (status, err.count("\n")) == (2, 1)
    assert "already contains a run" in err
    assert listing(tmp_path) == before


def test_run_in_unwritable_folder_ends_in_one_line(tmp_path):
    (tmp_path / "file").touch()
    for place in ("file/run", "/proc/none/run"):
        status, _, err = call([*TINY, "sampler=fps", f"hydra.run.dir={place}"], tmp_path)
        assert (status, err.count("\n")) == (2, 1)
        assert f"out: cannot write to {place}" in err
