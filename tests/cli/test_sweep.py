"""Cells of a sweep that is started again."""

import json
import math
import shutil
from functools import cache
from pathlib import Path

import pytest
from filelock import FileLock

from mops_lightning.cli.sweep import run_cell
from mops_lightning.cli.train import _check_score
from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.filesystem import TEMPORARY
from mops_lightning.records import run_record
from mops_lightning.records.run_record import ASIDE, FAILED
from mops_lightning.zoo import model_file, names
from tests.support.command_line import TINY, call, done
from tests.support.reports import rows

FPS = ("sampler=fps", "weights=null")
TRAINED = ("sampler=mops", "weights=null", "trainer.max_epochs=2")


def run_in(folder, arguments):
    """Run the cell of a folder, as a sweep does; its score."""
    overrides = [*TINY, f"cache={folder}/cache", *arguments]
    return run_cell(compose(overrides), folder / "cell", overrides)


@pytest.fixture
def start(tmp_path):
    """Start the cell, as a sweep does each time."""
    return lambda *arguments: run_in(tmp_path, arguments)


@pytest.fixture(scope="module")
def completed(tmp_path_factory):
    """A function that returns the folder of a completed cell, which is run once, and its score."""

    @cache
    def run_once(arguments):
        folder = tmp_path_factory.mktemp("completed")
        return folder, run_in(folder, arguments)

    return run_once


@pytest.fixture
def complete(completed, tmp_path):
    """A function that puts a completed cell into the test's folder; its score."""

    def copied(*arguments):
        folder, score = completed(arguments)
        shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
        return score

    return copied


def test_run_cell_completed_is_skipped(start, complete, tmp_path):
    score = complete(*FPS)
    path = tmp_path / "cell" / run_record.FILE
    before = path.stat().st_mtime_ns
    assert start(*FPS, "pictures=1", "out=elsewhere", "dataset.cache=there") == score
    assert path.stat().st_mtime_ns == before
    assert not (tmp_path / "cell" / ASIDE).exists()


def test_run_cell_other_settings_keeps_result(start, complete, tmp_path, caplog):
    score = complete(*FPS)
    assert math.isnan(start(*FPS, "seed=3"))
    assert "other settings: seed was 0, got 3" in caplog.text
    assert "hydra.sweep.dir" in (tmp_path / "cell" / FAILED).read_text()
    assert start(*FPS) == score
    assert not (tmp_path / "cell" / FAILED).exists()


def test_sweep_of_evaluations_started_again_is_skipped(tmp_path):
    more = ["sampler=snet", "val_fraction=0.25", "weights=null", "hydra.run.dir=trained"]
    done([*TINY, *more], tmp_path)
    sweep = ["-m", "evaluate=trained", "pictures=0", "logger=none", "hydra.sweep.dir=sweep"]
    for _ in range(2):
        out = done([*sweep, "test_corruption=null,shear-3"], tmp_path)
        assert "2 cells: 2 completed" in out
    assert out.count("already completed") == 2


def test_run_cell_failed_is_repeated(start, tmp_path, caplog):
    file = tmp_path / "net.pt"
    assert math.isnan(start("sampler=fps", f"weights={file}"))
    assert f"no file {file}" in caplog.text
    assert run_record.read(tmp_path / "cell").status == "failed"
    overrides = [*TINY, "learn=task"]
    run_cell(compose(overrides), tmp_path / "task", overrides)
    (tmp_path / "task" / "weights.safetensors").rename(file)
    assert math.isfinite(start("sampler=fps", f"weights={file}"))
    assert run_record.read(tmp_path / "cell").status == "completed"
    assert run_record.read(tmp_path / "cell" / ASIDE / "1").status == "failed"


def test_run_cell_failed_with_checkpoint_starts_again(start, complete, tmp_path):
    score = complete(*TRAINED)
    whole = run_record.read(tmp_path / "cell")
    failed = {**whole.plain(), "status": "failed", "score": None}
    (tmp_path / "cell" / run_record.FILE).write_text(json.dumps(failed))
    assert (tmp_path / "cell" / "checkpoints" / "last.ckpt").is_file()

    again = start(*TRAINED)

    assert again == score
    assert run_record.read(tmp_path / "cell").resumed_from is None


def test_run_cell_interrupted_resumes_to_same_result(start, complete, tmp_path):
    score = complete(*TRAINED)
    whole = run_record.read(tmp_path / "cell")
    # What a killed process leaves: a record that says "running", and its last checkpoint.
    path = tmp_path / "cell" / run_record.FILE
    path.write_text(json.dumps({**whole.plain(), "status": "running", "score": None}))
    assert start(*TRAINED) == score
    again = run_record.read(tmp_path / "cell")
    assert again.metrics == whole.metrics
    assert str(again.resumed_from).endswith(f"{ASIDE}/1/checkpoints/last.ckpt")
    assert start(*TRAINED) == score
    # Cut off again before it has a checkpoint of its own, or a record: the first one still counts.
    (tmp_path / "cell" / "checkpoints" / "last.ckpt").unlink(missing_ok=True)
    path.write_text(json.dumps({**again.plain(), "status": "interrupted", "score": None}))
    assert start(*TRAINED) == score
    for name in (run_record.FILE, "weights.safetensors"):
        (tmp_path / "cell" / name).unlink()
    (tmp_path / "cell" / "checkpoints" / "last.ckpt").unlink(missing_ok=True)
    assert start(*TRAINED) == score
    resumed = str(run_record.read(tmp_path / "cell").resumed_from)
    assert resumed.endswith(f"{ASIDE}/1/checkpoints/last.ckpt")
    # Of two checkpoints the newer one counts.
    (tmp_path / "cell" / "checkpoints").mkdir(exist_ok=True)
    shutil.copy(resumed, tmp_path / "cell" / "checkpoints")
    path.write_text(json.dumps({**again.plain(), "status": "interrupted", "score": None}))
    assert start(*TRAINED) == score
    resumed = str(run_record.read(tmp_path / "cell").resumed_from)
    assert resumed.endswith(f"{ASIDE}/3/checkpoints/last.ckpt")


class Killed(BaseException):
    """Stands for kill -9."""


@pytest.mark.parametrize("number", [1, 3, 5])
def test_run_cell_killed_while_setting_aside_recovers(
    start, complete, tmp_path, monkeypatch, number
):
    score = complete(*FPS)
    cell = tmp_path / "cell"
    record = run_record.read(cell)
    (cell / run_record.FILE).write_text(json.dumps({**record.plain(), "status": "interrupted"}))
    (cell / "checkpoints").mkdir()
    (cell / "pictures").mkdir()
    moved = {path.name for path in cell.iterdir()} - {".lock"}
    assert len(moved) == 4
    renames, rename = [], Path.rename

    def rename_or_die(path, target):
        renames.append(path)
        if len(renames) == number:
            raise Killed
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", rename_or_die)
        with pytest.raises(Killed):
            start(*FPS)
    assert start(*FPS) == score
    assert run_record.read(cell).status == "completed"
    assert {path.name for path in (cell / ASIDE / "1").iterdir()} == moved
    assert [path.name for path in (cell / ASIDE).iterdir()] == ["1"]


@pytest.mark.parametrize("name", ["checkpoints/last.ckpt", run_record.FILE])
def test_run_cell_damaged_file_fails_and_names_it(name, start, complete, tmp_path, caplog):
    complete(*TRAINED)
    cell = tmp_path / "cell"
    record = run_record.read(cell)
    (cell / run_record.FILE).write_text(json.dumps({**record.plain(), "status": "running"}))
    (cell / name).write_bytes((cell / name).read_bytes()[:1000])
    assert math.isnan(start(*TRAINED))
    assert f"{Path(name).name}" in caplog.text


def test_run_cell_busy_is_skipped(start, tmp_path, caplog):
    folder = tmp_path / "cell"
    folder.mkdir()
    with FileLock(folder / ".lock"):
        assert math.isnan(start("sampler=fps", "weights=null"))
    assert "another process runs this cell" in caplog.text
    assert not (folder / FAILED).exists()
    assert math.isfinite(start("sampler=fps", "weights=null"))


def test_run_cell_program_error_continues_sweep(start, tmp_path, monkeypatch, caplog):
    def broken(*_):
        raise RuntimeError("out of something")

    monkeypatch.setattr("mops_lightning.training.run.run.train_and_test", broken)
    assert math.isnan(start("sampler=fps", "weights=null"))
    assert (tmp_path / "cell" / FAILED).read_text() == "RuntimeError: out of something\n"
    assert "Traceback" in caplog.text


def test_sweep_with_cell_in_another_process_exits_with_zero(tmp_path):
    cell = tmp_path / "sweep" / "0"
    cell.mkdir(parents=True)
    with FileLock(cell / ".lock"):
        out = done(["-m", *TINY, "m=4", "hydra.sweep.dir=sweep"], tmp_path)
    assert "1 cells: 1 left to another process; in sweep" in out


def test_run_cell_removes_temporary_files(start, tmp_path):
    left = tmp_path / "cell" / "checkpoints" / f"{TEMPORARY}last-x.ckpt"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"half")
    start("sampler=fps", "weights=null")
    assert not left.exists()


def test_sweep_ends_in_models_whose_cards_name_each_other(tmp_path, monkeypatch):
    sweep = ["-m", *TINY, "hydra.callbacks.summary.models=true", "hydra.sweep.dir=Own"]
    subdir = "hydra.sweep.subdir=${run_label:}"
    grids = (
        "{learn: task, weights: null}, {sampler: mops, weights: Own/pointnet/weights.safetensors}"
    )
    grid = ["hydra/sweeper=grid", f"hydra.sweeper.grids=[{grids}]"]
    out = done([*sweep, subdir, *grid], tmp_path)
    assert "2 models in Own/models" in out
    monkeypatch.setenv("MOPS_MODELS", str(tmp_path / "Own/models"))
    card = model_file.read_card(names.available()["own.mops-m8"])
    assert card["record"]["files"]["task_weights"].startswith("own.pointnet@sha256:")
    out = done(["evaluate=own.mops-m8", "pictures=0", "logger=none"], tmp_path)
    assert card["figures"]["values"]["completed"] in out


def test_sweep_over_nine_values_ends_in_a_table_of_nine_rows(tmp_path):
    levels = [f"{number / 100:g}" for number in range(9)]
    sweep = ["-m", "sampler=fps", "learn=nothing", "weights=null", *TINY, "hydra.sweep.dir=nine"]

    out = done([*sweep, f"test_noise_std={','.join(levels)}"], tmp_path)

    assert "9 cells: 9 completed" in out
    found = [row[0] for row in rows((tmp_path / "nine" / "table.md").read_text())]
    assert [float(text) for text in found[1:]] == [float(level) for level in levels]


def test_sweep_whose_report_fails_ends_with_an_exit_status(tmp_path, monkeypatch):
    sweep = ["-m", "sampler=fps", "learn=nothing", "weights=null", *TINY, "hydra.sweep.dir=sweep"]
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "table.md").write_text("my own notes")
    status, out, err = call([*sweep, "seed=0,1"], tmp_path)
    assert (status, "2 cells: 2 completed" in out) == (2, True)
    assert "table.md: was not written by report" in err

    (tmp_path / "sweep" / "table.md").unlink()
    monkeypatch.setattr("mops_lightning.report.cli.markdown", None)  # a bug of the program
    status, out, err = call([*sweep, "seed=0,1"], tmp_path)
    assert status == 1
    assert "the end of the sweep failed" in out + err


def test_failed_cell_has_no_score_for_a_sweeper_that_optimises():
    _check_score(0.5, Path("cell"))
    for score in (None, math.nan):
        with pytest.raises(UserError, match=r"cell has no score; its log and result\.json say why"):
            _check_score(score, Path("cell"))
