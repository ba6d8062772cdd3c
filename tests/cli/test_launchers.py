"""Sweeps by other launchers than Hydra's own: the same cells, records and summary."""

import os

import pytest

from mops_lightning.records import run_record
from tests.support.command_line import TINY, call, done

LAUNCHERS = {
    "joblib": (["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"], [4, 8]),
    "submitit": (["hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=1"], [4]),
}
"""Settings, and the sizes of a sweep. Each cell is a process that imports torch and lightning."""


@pytest.mark.parametrize("name", LAUNCHERS)
def test_cells_run_side_by_side(name, tmp_path):
    launcher, sizes = LAUNCHERS[name]
    values = ",".join(str(size) for size in sizes)
    fixed = [*TINY, "sampler=random", "weights=null", "hydra.sweep.dir=cells"]

    out = done(["-m", *fixed, *launcher, f"m={values}"], tmp_path)

    assert f"{len(sizes)} cells: {len(sizes)} completed; in cells" in out
    for number, size in enumerate(sizes):
        record = run_record.read(tmp_path / "cells" / str(number))
        assert record.config["m"] == size
        if name == "joblib":  # it shares the cores out
            share = max(len(os.sched_getaffinity(0)) // 2, 1)
            assert record.threads == share


TRIALS = [
    "-m",
    *TINY,
    "weights=null",
    "hydra.sweep.dir=trials",
    "hydra/sweeper=optuna",
    "hydra.sweeper.direction=maximize",
]


def test_optuna_searches_and_keeps_every_trial(tmp_path):
    search = ["hydra.sweeper.n_trials=2", "sampler.alpha=interval(0.1,30)"]

    out = done([*TRIALS, *search], tmp_path)

    assert "Best parameters: {'sampler.alpha': " in out
    first = run_record.read(tmp_path / "trials" / "0").config["sampler"]["alpha"]
    second = run_record.read(tmp_path / "trials" / "1").config["sampler"]["alpha"]
    assert first != second
    assert 0.1 <= first <= 30
    assert 0.1 <= second <= 30


def test_optuna_is_told_of_failed_trials_and_searches_on(tmp_path):
    search = [
        "hydra.sweeper.n_trials=4",
        "hydra.sweeper.n_jobs=1",
        "hydra.sweeper.sampler.seed=1",
        "optimizer.lr=choice(0.001,1e30)",
    ]

    status, out, err = call([*TRIALS, *search], tmp_path)

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

    for cell in ("0", "1"):
        folders = list((tmp_path / "cells" / cell).glob("wandb/offline-run-*"))
        assert len(folders) == 1
