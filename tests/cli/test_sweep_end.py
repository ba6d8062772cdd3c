"""What the end of a sweep says and does."""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from filelock import FileLock
from omegaconf import OmegaConf

from mops_lightning.cli.sweep_end import BEGUN, SweepSummary, _let_search_go_on
from mops_lightning.records import run_record
from tests.support.reports import put_cell


def cell_of(folder, name, **changes):
    """A cell that a start of the sweep has begun."""
    path = put_cell(folder, name, "mops", {"generated": 1.0})
    hydra = path.parent / ".hydra"
    hydra.mkdir()
    (hydra / "overrides.yaml").touch()
    if changes:
        record = run_record.read(path.parent)
        for field, value in changes.items():
            setattr(record, field, value)
        run_record.write(path.parent, record)
    return path.parent


def config_of(folder: Path) -> Any:
    return SimpleNamespace(hydra=SimpleNamespace(sweep=SimpleNamespace(dir=str(folder))))


def test_end_of_a_sweep_counts_cells_by_state_and_says_how_to_repeat_the_rest(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / BEGUN).touch()
    sweep = tmp_path / "sweep"
    cell_of(sweep, "a")
    cell_of(sweep, "b", status="interrupted")
    (cell_of(sweep, "c") / ".failed").write_text("m is wrong")
    (cell_of(sweep, "d") / "result.json").unlink()
    elsewhere = cell_of(sweep, "e")

    with FileLock(elsewhere / ".lock"), pytest.raises(SystemExit) as stop:
        SweepSummary().on_multirun_end(config_of(sweep))

    assert stop.value.code == 1
    out = capsys.readouterr().out
    counts = "1 completed, 1 failed, 1 interrupted, 1 left to another process, 1 not started"
    assert out.startswith(f"5 cells: {counts}; in sweep\n")
    assert "files in sweep/: table.md" in out
    assert out.endswith("To repeat the rest: the same command with hydra.sweep.dir=sweep\n")


def test_end_of_a_sweep_counts_no_cells_of_an_earlier_start(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sweep = tmp_path / "sweep"
    cell = cell_of(sweep, "old", status="interrupted")
    os.utime(cell / ".hydra" / "overrides.yaml", (1e9, 1e9))
    (sweep / BEGUN).touch()

    with pytest.raises(SystemExit):
        SweepSummary().on_multirun_end(config_of(sweep))

    assert capsys.readouterr().out.startswith("0 cells: no values to sweep; in sweep\n")


@pytest.mark.parametrize(
    ("overrides", "rate"),
    [
        ([], 1.0),
        (["hydra.sweeper.n_trials=3"], 1.0),
        (["hydra.sweeper.max_failure_rate=0.2"], 0.2),
    ],
)
def test_search_survives_failed_trials_unless_their_share_is_given(overrides, rate):
    sweeper = {"max_failure_rate": 0.2}
    hydra = {"sweeper": sweeper, "overrides": {"hydra": overrides}}
    config = OmegaConf.create({"hydra": hydra})

    _let_search_go_on(config)

    assert config.hydra.sweeper.max_failure_rate == rate


def test_sweeper_without_a_rate_of_failures_gets_none():
    hydra = {"sweeper": {"params": None}, "overrides": {"hydra": []}}
    config = OmegaConf.create({"hydra": hydra})

    _let_search_go_on(config)

    assert list(config.hydra.sweeper) == ["params"]
