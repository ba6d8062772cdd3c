"""One run: load the data, pretrain the task net if needed, fit, test, save."""

from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import DictConfig

from mops_lightning.config import distributed
from mops_lightning.config.build import build
from mops_lightning.config.validate import check
from mops_lightning.data.clouds import CloudDataset, noisy
from mops_lightning.errors import UserError
from mops_lightning.records.run_record import RunRecord
from mops_lightning.records.summary import closing_lines
from mops_lightning.training import pretrain
from mops_lightning.training.evaluation.settings import as_trained
from mops_lightning.training.evaluation.trained_run import TrainedRun
from mops_lightning.training.job import prepare
from mops_lightning.training.recording import recorded
from mops_lightning.training.stages import fit_and_test

STARTED = ".started"
"""Empty file in the folder of a run that has begun."""


def run(
    cfg: DictConfig, folder: Path, overrides: list[str] | None = None, claimed: bool = False
) -> RunRecord:
    """Do what a configuration asks for and leave ``result.json`` in ``folder``.

    Args:
        cfg: a composed configuration.
        folder: the run's folder; must not hold a result yet.
        overrides: what the user changed, for the record.
        claimed: whether ``claim`` was called for the folder.

    Returns:
        The record, as written.

    Raises:
        UserError: a mistake in settings or files.
    """
    trained = TrainedRun.read(cfg.evaluate) if cfg.evaluate else None
    cfg = checked(cfg, trained, overrides)
    leads = not distributed.is_worker_rank(cfg)
    if leads and not claimed:
        claim(folder)
    with recorded(cfg, folder, overrides or []) as record:
        with record.timed("data"):
            dataset = _load_data(cfg)
        job = prepare(cfg, folder, dataset, record, trained)
        task_weights = None
        if job.has_task_weights:
            with record.timed("pretrain"):
                task_weights = pretrain.task_weights(cfg, dataset)
        fit_and_test(job, record, task_weights)
        pretrain.publish(job)
    if leads:
        closing_lines(folder, record)
    return record


def checked(cfg: DictConfig, trained: TrainedRun | None, overrides: list[str] | None) -> DictConfig:
    """Return the settings of a run, after mistakes in them were looked for.

    Raises:
        UserError: there is one.
    """
    if trained is not None and overrides is not None:
        return as_trained(cfg, trained, overrides)
    check(cfg)
    return cfg


def claim(folder: Path) -> None:
    """Make a run's folder and mark it as begun.

    Raises:
        UserError: the folder contains a run already, or cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"out: cannot write to {folder}: {error.strerror}.") from None
    try:
        # Two runs that start in the same second get the same folder; the second one stops here.
        (folder / STARTED).touch(exist_ok=False)
    except FileExistsError:
        raise UserError(
            f"{folder} already contains a run; runs are never overwritten. Start again for a "
            "new folder, and leave hydra.run.dir out or give another one."
        ) from None
    except OSError as error:
        raise UserError(f"out: cannot write to {folder}: {error.strerror}.") from None


def _load_data(cfg: DictConfig) -> CloudDataset:
    """Load both splits and add noise to the test clouds."""
    dataset = build(cfg.dataset, "dataset")
    if not isinstance(dataset, CloudDataset):
        raise UserError(
            f"dataset: {cfg.dataset.get('_target_')} must return a CloudDataset, got "
            f"{type(dataset).__name__}."
        )
    points = dataset.train.points.shape[1]
    if cfg.m > points:
        raise UserError(f"m must be at most the {points} points of a cloud, got m={cfg.m}.")
    test = noisy(dataset.test, cfg.test_noise_std)
    if not torch.isfinite(test.points).all():
        raise UserError(
            f"test_noise_std={cfg.test_noise_std} makes coordinates infinite. Lower it."
        )
    return replace(dataset, test=test)
