"""Evaluating a trained run: with other sizes, other data or another task net.

A run that trained only a task net is tested on full clouds.

``python -m mops_lightning evaluate=RUN sizes=[8,100]`` applies RUN's overrides, then those of the
command line, trains nothing, and writes a record of its own.
"""

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.records.run_record import Evaluated, RunRecord
from mops_lightning.training.checkpoint import CHECKPOINT
from mops_lightning.training.evaluated_settings import same_settings
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.replay import KEY, OF_RUN, place, trained_run
from mops_lightning.zoo import weights


def load(cfg: DictConfig, experiment: Experiment, dataset: CloudDataset) -> Evaluated:
    """Load the nets of the run that ``cfg.evaluate`` names into an experiment.

    Returns:
        The run and how it was trained, for the record.

    Raises:
        UserError: settings, classes or files do not match the run.
    """
    record, folder = trained_run(cfg.evaluate), place(cfg.evaluate)
    run = cfg.evaluate.removesuffix(f"/{run_record.FILE}")
    same_settings(cfg, record, run, experiment.task)
    own_data = record.dataset_fingerprint == dataset.fingerprint
    if experiment.task.requires_same_classes and cfg.weights == OF_RUN and not own_data:
        same_classes(record.class_names, dataset, f"{KEY}: {run}")
    learned = experiment.task if cfg.learn == "task" else experiment.sampler
    what = "task net" if cfg.learn == "task" else "sampler"
    assert learned is not None  # learn=nothing builds a sampler
    try:
        content = weights.load_into(learned, weights.of_run(folder))
    except UserError as error:
        raise UserError(f"{KEY}: the {what} of {run} cannot be loaded: {error}") from None
    has_weights = any(True for _ in experiment.task.parameters())
    if cfg.learn != "task" and cfg.weights == OF_RUN and has_weights:
        try:
            _load_task(experiment.task, folder, record)
        except UserError as error:
            raise UserError(f"{KEY}: {error}{_other_net(cfg, record)}") from None
    return Evaluated(
        run=run,
        commit=record.git["commit"],
        max_epochs=record.config["trainer"]["max_epochs"],
        learn=record.config["learn"],
        recipe=record.recipe,
        seed=record.seed,
        dataset=record.config["names"]["dataset"],
        weights_sha256=content["sha256"],
    )


def same_classes(names: list[str] | None, dataset: CloudDataset, what: str) -> None:
    """Reject a net whose class numbers differ from those of the data.

    Args:
        names: the classes that the net was trained on; None if unknown.
        dataset: the data.
        what: the file or folder of the net.

    Raises:
        UserError: they differ, or are unknown.
    """
    here = list(dataset.class_names)
    if names is None:
        raise UserError(
            f"{what} does not name the classes of its net, so it can be used with its own data "
            "only."
        )
    if list(names) != here:
        missing = [name for name in names if name not in here] or list(names)
        raise UserError(
            f"{what}: its net has {len(names)} classes, which are not the {len(here)} classes of "
            f"the data: {', '.join(missing[:3])} ... instead of {', '.join(here[:3])} .... "
            "Give a task net of these classes with weights=auto, or data of its classes with "
            "dataset.classes."
        )


def _load_task(task: torch.nn.Module, folder: Path, record: RunRecord) -> None:
    """Load the task net from a jointly trained run's weights, or from the run's checkpoint."""
    if "task_weights" in record.files:
        weights.load_into(task, weights.of_run(folder, "task_weights"))
        return
    path = folder / "checkpoints" / CHECKPOINT
    if folder.is_file():
        raise UserError(f"the model {folder.stem} comes without its task net. Give weights=FILE.")
    if not path.is_file():
        raise UserError(
            f"{path}, which contains the run's task net, does not exist. Give weights=FILE."
        )
    state = weights.read_plain(path, "a checkpoint")["state_dict"]
    own = {
        key.removeprefix("task."): value for key, value in state.items() if key.startswith("task.")
    }
    if weights.digest(own) != record.task_weights_sha256:
        raise UserError(f"{path} does not belong to the run in its folder. Give weights=FILE.")
    weights.fit_state(task, own, path)


def _other_net(cfg: DictConfig, record: RunRecord) -> str:
    """Return the settings of the task net in which an evaluation differs from its run."""
    here: Any = OmegaConf.to_container(cfg.task.net, resolve=True)
    there = record.config["task"].get("net") or {}
    changed = [
        f"task.net.{key} is {here.get(key)} here and was {there.get(key)}"
        for key in {**there, **here}
        if here.get(key) != there.get(key)
    ]
    return f" Cause: {', '.join(changed)}." if changed else ""
