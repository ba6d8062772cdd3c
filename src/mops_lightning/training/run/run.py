"""One run: load the data, pretrain the task net if needed, fit, test, save."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mops_lightning.config import distributed
from mops_lightning.config.build import build_as
from mops_lightning.config.validate import check
from mops_lightning.data.clouds import CloudDataset, noisy, scale_warning
from mops_lightning.errors import UserError
from mops_lightning.records.run_record import RunRecord
from mops_lightning.records.summary import closing_lines
from mops_lightning.training.as_trained import as_trained, lost_baselines
from mops_lightning.training.evaluation import TrainedRun
from mops_lightning.training.run import pretrain
from mops_lightning.training.run.build import build_parts
from mops_lightning.training.run.channels import scaled_as_trained
from mops_lightning.training.run.ending import sigterm_as_ctrl_c
from mops_lightning.training.run.recorded import recorded
from mops_lightning.training.run.stages import train_and_test

STARTED = ".started"
"""Empty file in the folder of a run that has begun."""


def run(cfg: DictConfig, folder: Path, overrides: list[str] | None = None) -> RunRecord:
    """Train and test as a configuration says, and write ``result.json`` into ``folder``.

    Args:
        cfg: a composed configuration.
        folder: the run's folder; must not hold a result yet.
        overrides: what the user changed, for the record.

    Returns:
        The record, as written.

    Raises:
        UserError: a mistake in settings or files.
    """
    overrides = overrides or []
    cfg = checked(cfg, overrides)
    if not distributed.is_worker_rank(cfg):
        claim(folder)
    return run_in(folder, cfg, overrides)


def run_in(folder: Path, cfg: DictConfig, overrides: list[str]) -> RunRecord:
    """Do as ``run`` does, with settings that are ``checked`` and a folder that is claimed.

    Args:
        folder: the run's folder, after ``claim``.
        cfg: the settings, as ``checked`` returned them.
        overrides: what the user changed, for the record.
    """
    trained = TrainedRun.read(cfg.evaluate) if cfg.evaluate else None
    writes = not distributed.is_worker_rank(cfg)
    if trained and writes:
        _say_lost_baselines(lost_baselines(cfg, trained, overrides), trained)
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    with sigterm_as_ctrl_c(), recorded(settings, folder, overrides, writes) as record:
        with record.timed("data"):
            dataset = _load_data(cfg, trained)
        parts = build_parts(cfg, folder, dataset, record, trained)
        task_weights = None
        if parts.has_task_weights:
            with record.timed("pretrain"):
                task_weights = pretrain.task_weights(cfg, dataset, folder)
        train_and_test(parts, record, task_weights)
        pretrain.add_to_cache(parts, record)
    if writes:
        closing_lines(folder, record)
    return record


def checked(cfg: DictConfig, overrides: list[str]) -> DictConfig:
    """Return the checked settings of a run; those of an evaluation are the trained run's.

    Raises:
        UserError: a mistake in the settings.
    """
    if cfg.evaluate:
        return as_trained(cfg, TrainedRun.read(cfg.evaluate), overrides)
    check(cfg)
    return cfg


def _say_lost_baselines(names: list[str], trained: TrainedRun) -> None:
    if not names:
        return
    name = names[0]
    adding = [f"+sampler@baselines.{name}=SAMPLER"]
    for setting, value in trained.record.config["baselines"][name].items():
        if setting != "_target_":
            adding.append(f"+baselines.{name}.{setting}={value}")
    print(
        f"Not tested here: {', '.join(names)}, which an experiment had added to the baselines "
        f"of {trained.name}. {' '.join(adding)} adds it.",
        flush=True,
    )


def claim(folder: Path) -> None:
    """Make a run's folder and mark it as begun.

    Raises:
        UserError: the folder contains a run already, or cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / STARTED).touch(exist_ok=False)
    except OSError as error:
        if (folder / STARTED).is_file():
            raise UserError(
                f"{folder} already contains a run; runs are never overwritten. Start again for a "
                "new folder, and leave hydra.run.dir out or give another one."
            ) from None
        raise UserError(f"out: cannot write to {folder}: {error.strerror}.") from None


def _load_data(cfg: DictConfig, trained: TrainedRun | None = None) -> CloudDataset:
    """Load both splits, scale channels as given nets were trained, and corrupt the test clouds."""
    dataset: CloudDataset = build_as(CloudDataset, cfg.dataset, "dataset")
    dataset = scaled_as_trained(dataset, cfg, trained)
    warning = scale_warning(dataset)
    if warning:
        print(warning, file=sys.stderr)
    test = dataset.test
    if cfg.test_corruption:
        from mops_lightning.data.corruptions import corrupt

        test = corrupt(test, cfg.test_corruption, dataset.channels)
    return replace(dataset, test=noisy(test, cfg.test_noise_std))
