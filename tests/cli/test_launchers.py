"""Sweeps by other launchers than Hydra's own: the same cells, records and summary."""

import json
import os

import pytest

from tests.support.command_line import TINY, call, done

LAUNCHERS = {
    "joblib": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "m=4,8"],
    "submitit": ["hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=1", "m=4"],
}
"""Each cell is a process that imports torch and lightning."""


@pytest.mark.parametrize("name", LAUNCHERS)
def test_cells_run_side_by_side(name, tmp_path):
    sizes = [4, 8] if name == "joblib" else [4]
    fixed = [*TINY, "sampler=random", "weights=null", "hydra.sweep.dir=cells"]
    command = ["-m", *fixed, *LAUNCHERS[name]]
    out = done(command, tmp_path)
    assert f"{len(sizes)} cells: {len(sizes)} completed; in cells" in out
    places = [tmp_path / "cells" / str(cell) / "result.json" for cell in range(len(sizes))]
    found = [json.loads(path.read_text()) for path in places]
    assert [record["config"]["m"] for record in found] == sizes
    if name == "joblib":  # it shares the cores out
        share = max(len(os.sched_getaffinity(0)) // 2, 1)
        assert [record["threads"] for record in found] == [share] * 2


def test_optuna_searches_and_keeps_every_trial(tmp_path):
    search = ["hydra/sweeper=optuna", "hydra.sweeper.n_trials=2", "sampler.alpha=interval(0.1,30)"]
    settings = [*TINY, "weights=null", "hydra.sweep.dir=trials"]
    command = ["-m", *search, *settings, "hydra.sweeper.direction=maximize"]
    out = done(command, tmp_path)
    assert "Best parameters: {'sampler.alpha': " in out
    found = [json.loads((tmp_path / "trials" / cell / "result.json").read_text()) for cell in "01"]
    alphas = {record["config"]["sampler"]["alpha"] for record in found}
    assert len(alphas) == 2
    assert all(0.1 <= alpha <= 30 for alpha in alphas)


def test_optuna_is_told_of_failed_trials_and_searches_on(tmp_path):
    search = ["hydra/sweeper=optuna", "hydra.sweeper.n_trials=4", "hydra.sweeper.n_jobs=1"]
    choice = ["hydra.sweeper.sampler.seed=1", "optimizer.lr=choice(0.001,1e30)"]
    settings = [*TINY, "weights=null", "hydra.sweep.dir=trials", "hydra.sweeper.direction=maximize"]

    status, out, err = call(["-m", *search, *choice, *settings], tmp_path)

    assert status == 1, err  # as any sweep with failed cells
    assert "Best parameters: {'optimizer.lr': 0.001}" in out
    assert "failed: training diverged" in out
    assert "Traceback" not in err


def test_wandb_has_one_run_for_each_cell(tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="the extra 'wandb' is not installed")
    monkeypatch.setenv("WANDB_SILENT", "true")
    tiny = [one for one in TINY if one != "logger=none"]
    logger = ["logger=wandb", "logger.offline=true", "hydra.sweep.dir=cells"]

    done(["-m", *tiny, *logger, "weights=null", "sampler.alpha=1,2"], tmp_path)

    found = [len(list((tmp_path / "cells" / cell).glob("wandb/offline-run-*"))) for cell in "01"]
    assert found == [1, 1]
