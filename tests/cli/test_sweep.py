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
CHECKPOINT = "checkpoints/last.ckpt"


def rewrite(record, cell, **changes):
    """Write a record with other values into a cell, as a stopped process leaves it."""
    fields = {**record.plain(), **changes}
    (cell / run_record.FILE).write_text(json.dumps(fields))


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

    again = start(*FPS, "pictures=1", "out=elsewhere", "dataset.cache=there")

    assert again == score
    assert path.stat().st_mtime_ns == before
    assert not (tmp_path / "cell" / ASIDE).exists()


def test_run_cell_other_settings_keeps_result(start, complete, tmp_path, caplog):
    score = complete(*FPS)
    failed = tmp_path / "cell" / FAILED

    other = start(*FPS, "seed=3")

    assert math.isnan(other)
    assert "other settings: seed was 0, got 3" in caplog.text
    assert "hydra.sweep.dir" in failed.read_text()

    again = start(*FPS)

    assert again == score
    assert not failed.exists()


def test_sweep_of_evaluations_started_again_is_skipped(tmp_path):
    more = ["sampler=snet", "val_fraction=0.25", "weights=null", "hydra.run.dir=trained"]
    done([*TINY, *more], tmp_path)
    sweep = [
        "-m",
        "evaluate=trained",
        "pictures=0",
        "logger=none",
        "hydra.sweep.dir=sweep",
        "test_corruption=null,shear-3",
    ]

    first = done(sweep, tmp_path)
    second = done(sweep, tmp_path)

    assert "2 cells: 2 completed" in first
    assert "2 cells: 2 completed" in second
    assert second.count("already completed") == 2


def test_run_cell_failed_is_repeated(start, tmp_path, caplog):
    cell = tmp_path / "cell"
    file = tmp_path / "net.pt"

    without_net = start("sampler=fps", f"weights={file}")

    assert math.isnan(without_net)
    assert f"no file {file}" in caplog.text
    assert run_record.read(cell).status == "failed"

    overrides = [*TINY, "learn=task"]
    run_cell(compose(overrides), tmp_path / "task", overrides)
    (tmp_path / "task" / "weights.safetensors").rename(file)
    with_net = start("sampler=fps", f"weights={file}")

    assert math.isfinite(with_net)
    assert run_record.read(cell).status == "completed"
    assert run_record.read(cell / ASIDE / "1").status == "failed"


def test_run_cell_failed_with_checkpoint_starts_again(start, complete, tmp_path):
    score = complete(*TRAINED)
    cell = tmp_path / "cell"
    rewrite(run_record.read(cell), cell, status="failed", score=None)
    assert (cell / CHECKPOINT).is_file()

    again = start(*TRAINED)

    assert again == score
    assert run_record.read(cell).resumed_from is None


def test_run_cell_interrupted_resumes_to_same_result(start, complete, tmp_path):
    score = complete(*TRAINED)
    cell = tmp_path / "cell"
    whole = run_record.read(cell)

    # What a killed process leaves: a record that says "running", and its last checkpoint.
    rewrite(whole, cell, status="running", score=None)
    assert start(*TRAINED) == score
    again = run_record.read(cell)
    assert again.metrics == whole.metrics
    assert str(again.resumed_from).endswith(f"{ASIDE}/1/{CHECKPOINT}")

    assert start(*TRAINED) == score

    # Cut off again before it has a checkpoint of its own, or a record: the first one still counts.
    (cell / CHECKPOINT).unlink(missing_ok=True)
    rewrite(again, cell, status="interrupted", score=None)
    assert start(*TRAINED) == score

    (cell / CHECKPOINT).unlink(missing_ok=True)
    (cell / run_record.FILE).unlink()
    (cell / "weights.safetensors").unlink()
    assert start(*TRAINED) == score
    resumed = str(run_record.read(cell).resumed_from)
    assert resumed.endswith(f"{ASIDE}/1/{CHECKPOINT}")

    # Of two checkpoints the newer one counts.
    (cell / "checkpoints").mkdir(exist_ok=True)
    shutil.copy(resumed, cell / "checkpoints")
    rewrite(again, cell, status="interrupted", score=None)
    assert start(*TRAINED) == score
    resumed = str(run_record.read(cell).resumed_from)
    assert resumed.endswith(f"{ASIDE}/3/{CHECKPOINT}")


def test_run_cell_resumes_the_tenth_attempt_before_the_ninth(start, complete, tmp_path):
    complete(*TRAINED)
    cell = tmp_path / "cell"
    rewrite(run_record.read(cell), cell, status="interrupted", score=None)
    attempts = tmp_path / "attempts"
    shutil.copytree(cell, attempts / "9")
    cell.rename(attempts / "10")
    cell.mkdir()
    attempts.rename(cell / ASIDE)

    start(*TRAINED)

    resumed = str(run_record.read(cell).resumed_from)
    assert resumed.endswith(f"{ASIDE}/10/{CHECKPOINT}")


class Killed(BaseException):
    """Stands for kill -9."""


@pytest.mark.parametrize("number", [1, 3, 5])
def test_run_cell_killed_while_setting_aside_recovers(
    start, complete, tmp_path, monkeypatch, number
):
    score = complete(*FPS)
    cell = tmp_path / "cell"
    rewrite(run_record.read(cell), cell, status="interrupted")
    (cell / "checkpoints").mkdir()
    (cell / "pictures").mkdir()
    moved = names_in(cell) - {".lock"}
    assert len(moved) == 4
    renamed = []
    rename = Path.rename

    def rename_or_die(path, target):
        renamed.append(path)
        if len(renamed) == number:
            raise Killed
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", rename_or_die)
        with pytest.raises(Killed):
            start(*FPS)

    again = start(*FPS)

    assert again == score
    assert run_record.read(cell).status == "completed"
    assert names_in(cell / ASIDE) == {"1"}
    assert names_in(cell / ASIDE / "1") == moved


def names_in(folder):
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("name", [CHECKPOINT, run_record.FILE])
def test_run_cell_damaged_file_fails_and_names_it(name, start, complete, tmp_path, caplog):
    complete(*TRAINED)
    cell = tmp_path / "cell"
    rewrite(run_record.read(cell), cell, status="running")
    damaged = cell / name
    damaged.write_bytes(damaged.read_bytes()[:1000])

    score = start(*TRAINED)

    assert math.isnan(score)
    assert damaged.name in caplog.text


def test_run_cell_busy_is_skipped(start, tmp_path, caplog):
    folder = tmp_path / "cell"
    folder.mkdir()

    with FileLock(folder / ".lock"):
        skipped = start(*FPS)

    assert math.isnan(skipped)
    assert "another process runs this cell" in caplog.text
    assert not (folder / FAILED).exists()

    score = start(*FPS)

    assert math.isfinite(score)


def test_run_cell_program_error_continues_sweep(start, tmp_path, monkeypatch, caplog):
    def broken(*_):
        raise RuntimeError("out of something")

    monkeypatch.setattr("mops_lightning.training.run.run.train_and_test", broken)

    score = start(*FPS)

    assert math.isnan(score)
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

    start(*FPS)

    assert not left.exists()


def test_sweep_ends_in_models_whose_cards_name_each_other(tmp_path, monkeypatch):
    net = "{learn: task, weights: null}"
    sampler = "{sampler: mops, weights: Own/pointnet/weights.safetensors}"
    sweep = [
        "-m",
        *TINY,
        "hydra.callbacks.summary.models=true",
        "hydra.sweep.dir=Own",
        "hydra.sweep.subdir=${run_label:}",
        "hydra/sweeper=grid",
        f"hydra.sweeper.grids=[{net}, {sampler}]",
    ]

    out = done(sweep, tmp_path)

    assert "2 models in Own/models" in out
    monkeypatch.setenv("MOPS_MODELS", str(tmp_path / "Own/models"))
    model = names.available()["own.mops-m8"]
    card = model_file.read_card(model)
    of_task_net = card["record"]["files"]["task_weights"]
    assert of_task_net.startswith("own.pointnet@sha256:")

    out = done(["evaluate=own.mops-m8", "pictures=0", "logger=none"], tmp_path)

    assert card["figures"]["values"]["completed"] in out


SWEEP_OF_FPS = ["-m", "sampler=fps", "learn=nothing", "weights=null", *TINY]


def test_sweep_over_nine_values_ends_in_a_table_of_nine_rows(tmp_path):
    levels = [0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08]
    values = ",".join(str(level) for level in levels)

    out = done([*SWEEP_OF_FPS, "hydra.sweep.dir=nine", f"test_noise_std={values}"], tmp_path)

    assert "9 cells: 9 completed" in out
    table = (tmp_path / "nine" / "table.md").read_text()
    _, *lines = rows(table)
    assert [float(line[0]) for line in lines] == levels


def test_sweep_whose_report_fails_ends_with_an_exit_status(tmp_path, monkeypatch):
    sweep = [*SWEEP_OF_FPS, "hydra.sweep.dir=sweep", "seed=0,1"]
    (tmp_path / "sweep").mkdir()
    table = tmp_path / "sweep" / "table.md"
    table.write_text("my own notes")

    status, out, err = call(sweep, tmp_path)

    assert status == 2
    assert "2 cells: 2 completed" in out
    assert "table.md: was not written by report" in err

    table.unlink()
    monkeypatch.setattr("mops_lightning.report.cli.markdown", None)  # a bug of the program

    status, out, err = call(sweep, tmp_path)

    assert status == 1
    assert "the end of the sweep failed" in out + err


def test_failed_cell_has_no_score_for_a_sweeper_that_optimises():
    _check_score(0.5, Path("cell"))
    for score in (None, math.nan):
        with pytest.raises(UserError, match=r"cell has no score; its log and result\.json say why"):
            _check_score(score, Path("cell"))
