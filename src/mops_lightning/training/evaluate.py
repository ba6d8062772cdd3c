"""Evaluating a trained run: with other sizes, other data or another task net.

A run that trained only a task net is tested on full clouds.

``python -m mops_lightning evaluate=RUN sizes=[8,100]`` applies RUN's overrides, then those of the
command line, trains nothing, and writes a record of its own.
"""

from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf, open_dict

from mops_lightning.config import overrides, settings
from mops_lightning.config.build import signature
from mops_lightning.config.declaration import Affects
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.training.checkpoint import CHECKPOINT
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.replay import KEY, OF_RUN, names_code, place, trained_run
from mops_lightning.zoo import weights
from mops_lightning.zoo.closed_list import attributes_in


def as_trained(cfg: DictConfig, given: list[str]) -> DictConfig:
    """Return the configuration of an evaluation with its run's values of the sampler's settings.

    The defaults may have changed since. Only plain values are taken from a record, as from its
    overrides. What is given explicitly stays, for ``load`` to judge.

    Args:
        cfg: a composed configuration.
        given: the overrides it was composed from.

    Raises:
        UserError: ``cfg.evaluate`` is not a completed run that trained something.
    """
    if not cfg.evaluate or cfg.learn == "task":
        return cfg
    there = trained_run(cfg.evaluate)["config"]
    if there["names"]["sampler"] != cfg.names.sampler:
        return cfg
    here: Any = OmegaConf.to_container(cfg.sampler, resolve=True)
    keys = {overrides.key(argument) for argument in given}
    changed = {
        key: old
        for key, (old, _) in _differences(here, there["sampler"]).items()
        if f"sampler.{key}" not in keys and not OmegaConf.is_interpolation(cfg.sampler, key)
    }
    plain = {key: old for key, old in changed.items() if not names_code({key: old})}
    cfg = deepcopy(cfg)
    with open_dict(cfg):
        cfg.sampler.update(plain)
    return cfg


def load(cfg: DictConfig, experiment: Experiment, dataset: CloudDataset) -> dict[str, Any]:
    """Load the nets of the run that ``cfg.evaluate`` names into an experiment.

    Returns:
        Notes for the record: the run and how it was trained.

    Raises:
        UserError: settings, classes or files do not match the run.
    """
    record, folder = trained_run(cfg.evaluate), place(cfg.evaluate)
    run = cfg.evaluate.removesuffix(f"/{run_record.FILE}")
    _same_settings(cfg, record, run, experiment.task)
    notes = record["notes"]
    own_data = notes.get("dataset_fingerprint") == dataset.fingerprint
    if experiment.task.requires_same_classes and cfg.weights == OF_RUN and not own_data:
        same_classes(notes.get("class_names"), dataset, f"{KEY}: {run}")
    same_attributes(record["config"], dataset, f"{KEY}: {run}")
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
    return {
        "run": run,
        "commit": record["git"]["commit"],
        "max_epochs": record["config"]["trainer"]["max_epochs"],
        "learn": record["config"]["learn"],
        "recipe": notes.get("recipe"),
        "seed": record["seed"],
        "dataset": record["config"]["names"]["dataset"],
        f"{'task' if cfg.learn == 'task' else 'sampler'}_weights_sha256": content["sha256"],
    }


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


def same_attributes(config: dict[str, Any], dataset: CloudDataset, what: str) -> None:
    """Reject a net that takes other attributes than the data have.

    Args:
        config: of the run that trained the net.
        dataset: the data.
        what: the file or folder of the net.

    Raises:
        UserError: names or their order differ.
    """
    there, here = attributes_in(config), list(dataset.attributes)
    if there != here:
        raise UserError(
            f"{what} was trained with dataset.features=[{','.join(there)}], got "
            f"[{','.join(here)}]. Give the same ones, or other weights."
        )


def _load_task(task: torch.nn.Module, folder: Path, record: dict[str, Any]) -> None:
    """Load the task net from a jointly trained run's weights, or from the run's checkpoint."""
    if "task_weights" in record["files"]:
        weights.load_into(task, weights.of_run(folder, "task_weights"))
        return
    path = folder / "checkpoints" / CHECKPOINT
    if not path.is_file():
        raise UserError(
            f"{path}, which contains the run's task net, does not exist. Give weights=FILE."
        )
    state = weights.read_plain(path, "a checkpoint")["state_dict"]
    own = {
        key.removeprefix("task."): value for key, value in state.items() if key.startswith("task.")
    }
    if weights.digest(own) != record["notes"].get("task_weights_sha256"):
        raise UserError(f"{path} does not belong to the run in its folder. Give weights=FILE.")
    weights.fit_state(task, own, path)


def _other_net(cfg: DictConfig, record: dict[str, Any]) -> str:
    """Return the settings of the task net in which an evaluation differs from its run."""
    here: Any = OmegaConf.to_container(cfg.task.net, resolve=True)
    there = record["config"]["task"].get("net") or {}
    changed = [
        f"task.net.{key} is {here.get(key)} here and was {there.get(key)}"
        for key in {**there, **here}
        if here.get(key) != there.get(key)
    ]
    return f" Cause: {', '.join(changed)}." if changed else ""


def _same_settings(
    cfg: DictConfig, record: dict[str, Any], run: str, task: torch.nn.Module
) -> None:
    there = record["config"]
    here: Any = OmegaConf.to_container(cfg, resolve=True)
    if (cfg.learn == "task") != (there["learn"] == "task"):
        raise UserError(
            f"{KEY}: {run} was made with learn={there['learn']}; leave learn out. To test a "
            "sampler with this task net, evaluate the sampler's run with "
            f"weights={weights.of_run(place(run))}."
        )
    if cfg.learn == "task" and cfg.weights != OF_RUN:
        raise UserError(f"{KEY}: {run} trained a task net; leave weights out.")
    for group in ("task",) if cfg.learn == "task" else ("task", "sampler"):
        old, new = there["names"][group], here["names"][group]
        if old != new:
            raise UserError(
                f"{KEY}: {run} was trained with {group}={old}, got {group}={new}. "
                f"Leave {group} out, or give a run with {group}={new}."
            )
    weightless = not any(True for _ in task.parameters())
    if here["names"]["net"] != there["names"]["net"] and cfg.weights == OF_RUN and not weightless:
        raise UserError(
            f"{KEY}: the task net of {run} is {there['names']['net']}; for "
            f"task/net={here['names']['net']} also give its weights: weights=auto or weights=FILE."
        )
    if cfg.learn != "task":
        _same_sampler(here["sampler"], there["sampler"], run)


def _same_sampler(here: dict[str, Any], there: dict[str, Any], run: str) -> None:
    for key, (old, new) in _differences(here, there).items():
        hint = " For other sizes of a flexible sampler give sizes=[...]." if key == "m" else ""
        raise UserError(
            f"{KEY}: sampler.{key} must be {old}, as in {run}, got {new}. "
            f"Leave it out, or train a sampler with it.{hint}"
        )


def _differences(here: dict[str, Any], there: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the settings of the training in which two samplers differ: old and new value.

    Records lack settings that are newer than they: those have the constructor's default.
    """
    defaults = {
        key: list(one.default) if isinstance(one.default, tuple) else one.default
        for key, one in signature(str(here["_target_"]), "sampler").items()
    }
    pairs = {
        key: tuple(node.get(key, defaults.get(key)) for node in (there, here))
        for key in sorted({*there, *here})
        if Affects.TRAINING in settings.of(f"sampler.{key}").affects
    }
    return {key: (old, new) for key, (old, new) in pairs.items() if old != new}
