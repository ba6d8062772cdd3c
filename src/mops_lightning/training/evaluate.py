"""Testing a trained run anew: on other sizes, other data or under another task net.

A run that trained a task net alone is tested on all points of its data or of others.

``python -m mops_lightning evaluate=RUN sizes=[8,100]`` repeats what RUN was told, then what stands
on the command line, trains nothing, and leaves a record of its own.
"""

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from mops_lightning.config import overrides, settings
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.training.callbacks import CHECKPOINT
from mops_lightning.training.experiment import Experiment
from mops_lightning.zoo import weights

KEY = "evaluate"
OF_RUN = "run"
"""``weights=run``: the task net that the evaluated run was trained with."""


def command_line(arguments: list[str]) -> list[str]:
    """Put a run's own overrides before the user's where ``evaluate=RUN`` is among these.

    Args:
        arguments: as typed, without the program's name.

    Returns:
        The arguments to go on with.

    Raises:
        UserError: RUN is no run with a trained sampler.
    """
    places = [i for i, a in enumerate(arguments) if overrides.key(a) == KEY]
    chosen = _chosen(arguments[places[-1]]) if places else None
    if not chosen:
        return arguments
    folder = Path(chosen).expanduser()
    record = trained_run(folder)
    names = record["config"]["names"]
    groups = {"task": names["task"], "dataset": names["dataset"], "sampler": names["sampler"]}
    typed = [a for i, a in enumerate(arguments) if i not in places and overrides.key(a)]
    # Naming what the run has anyway changes nothing, its settings below it stay too.
    typed_keys = [
        overrides.key(a) for a in typed if a not in [f"{k}={v}" for k, v in groups.items()]
    ]
    earlier = [overrides.readable(a) for a in record["overrides"] if overrides.key(a) not in groups]
    earlier = [f"{group}={name}" for group, name in groups.items()] + earlier
    kept = [
        a
        for a in earlier
        if settings.of(overrides.path(a)).repeated
        and not any(_covers(key, overrides.key(a)) for key in typed_keys)
    ]
    _data_are_here(kept, folder)
    learn = "task" if record["config"]["learn"] == "task" else "nothing"
    own = [*kept, f"learn={learn}", f"weights={OF_RUN}", f"{KEY}={overrides.quote(str(folder))}"]
    # In one place: flags may stand before or behind all overrides, not between them.
    before = [a for i, a in enumerate(arguments[: places[0]]) if i not in places]
    behind = [a for i, a in enumerate(arguments) if i > places[0] and i not in places]
    given = {overrides.key(a) for a in typed}
    defaults = [a for a in own if overrides.key(a) not in given]
    return [*before, *defaults, *behind]


def _chosen(argument: str) -> str | None:
    """Return the run that ``evaluate=RUN`` names."""
    override = overrides.parse(argument)
    if override is None or override.is_delete():
        return None
    if override.is_sweep_override():
        raise UserError(f"{argument}: {KEY} takes one run. Start one evaluation for each.")
    value = override.value()
    return None if value is None else str(value)


def _data_are_here(kept: list[str], folder: Path) -> None:
    """Refuse a folder of data that is named from where the run was started, which is elsewhere."""
    for argument in kept:
        override = overrides.parse(argument)
        if override is None or overrides.key(argument) != "dataset.root" or not override.value():
            continue
        if not Path(str(override.value())).expanduser().exists():
            raise UserError(
                f"{KEY}: {folder} had its data in {argument}, which is not there, seen from this "
                "folder. Say where they are: dataset.root=PATH."
            )


def trained_run(folder: Path) -> dict[str, Any]:
    """Return the record of a completed run that trained something.

    Raises:
        UserError: it is none.
    """
    if folder.name == run_record.FILE:
        folder = folder.parent
    if not folder.is_dir():
        raise UserError(f"{KEY}: no folder {folder}. Give the folder of a run, with result.json.")
    record = run_record.read(folder)
    if record["status"] != "completed":
        hint = "Name a completed run."
        if (folder / "checkpoints" / CHECKPOINT).is_file():
            hint = f"Finish it with its own command and ckpt_path={folder}."
        raise UserError(f"{KEY}: {folder} is {record['status']}, not completed. {hint}")
    if "weights" not in record["files"]:
        raise UserError(
            f"{KEY}: {folder} trained nothing, or its weights were not kept; "
            "run its own command with other settings."
        )
    return record


def load(cfg: DictConfig, experiment: Experiment, dataset: CloudDataset) -> dict[str, Any]:
    """Fill an experiment with the nets of the run that ``cfg.evaluate`` names.

    Returns:
        Notes for the record: which run, and what made it.

    Raises:
        UserError: settings, classes or files do not fit the run.
    """
    record = trained_run(Path(cfg.evaluate))
    folder = Path(cfg.evaluate.removesuffix(run_record.FILE))
    _same_settings(cfg, record, folder, experiment.task)
    notes = record["notes"]
    told = experiment.task.requires_same_classes
    if told and cfg.weights == OF_RUN and notes.get("dataset_fingerprint") != dataset.fingerprint:
        same_classes(notes.get("class_names"), dataset, f"{KEY}: {folder}")
    learned = experiment.task if cfg.learn == "task" else experiment.sampler
    what = "task net" if cfg.learn == "task" else "sampler"
    assert learned is not None  # learn=nothing builds a sampler
    try:
        content = weights.load_into(learned, weights.of_run(folder))
    except UserError as error:
        raise UserError(f"{KEY}: the {what} of {folder} cannot be had: {error}") from None
    has_weights = any(True for _ in experiment.task.parameters())
    if cfg.learn != "task" and cfg.weights == OF_RUN and has_weights:
        try:
            _load_task(experiment.task, folder, record)
        except UserError as error:
            raise UserError(f"{error}{_other_net(cfg, record)}") from None
    return {
        "run": str(folder),
        "commit": record["git"]["commit"],
        "max_epochs": record["config"]["trainer"]["max_epochs"],
        "learn": record["config"]["learn"],
        "seed": record["seed"],
        "dataset": record["config"]["names"]["dataset"],
        f"{what.split()[0]}_weights_sha256": content["sha256"],
    }


def same_classes(names: list[str] | None, dataset: CloudDataset, what: str) -> None:
    """Refuse a net that numbers its classes in another way than the data do.

    Args:
        names: the classes that the net was trained on; None where nobody noted them.
        dataset: the data.
        what: the file or folder of the net.

    Raises:
        UserError: they differ, or are not known.
    """
    here = list(dataset.class_names)
    if names is None:
        raise UserError(
            f"{what} does not say which classes its net tells apart, so it can be used on its own "
            "data only."
        )
    if list(names) != here:
        missing = [name for name in names if name not in here] or list(names)
        raise UserError(
            f"{what}: its net tells apart {len(names)} classes that are not those of the data "
            f"({len(here)}): {', '.join(missing[:3])} ... against {', '.join(here[:3])} .... "
            "Give a task net of these classes with weights=auto, or data of its classes with "
            "dataset.classes."
        )


def _load_task(task: torch.nn.Module, folder: Path, record: dict[str, Any]) -> None:
    """Take the task net from a jointly trained run's file, or from the run's checkpoint."""
    name = record["files"].get("task_weights")
    if name is not None:
        weights.load_into(task, folder / name)
        return
    path = folder / "checkpoints" / CHECKPOINT
    if not path.is_file():
        raise UserError(
            f"{KEY}: {path}, which holds the run's task net, is gone. Give one with weights=."
        )
    state = weights.read_plain(path, KEY, "a checkpoint")["state_dict"]
    own = {key.removeprefix("task."): value for key, value in state.items() if key[:5] == "task."}
    if weights.digest(own) != record["notes"].get("task_weights_sha256"):
        raise UserError(f"{KEY}: {path} is not of the run in its folder. Give weights=.")
    weights.fit_state(task, own, path)


def _other_net(cfg: DictConfig, record: dict[str, Any]) -> str:
    """Say in which settings of the task net an evaluation differs from its run."""
    here: Any = OmegaConf.to_container(cfg.task.net, resolve=True)
    there = record["config"]["task"].get("net") or {}
    changed = [
        f"task.net.{key} is {here.get(key)} here and was {there.get(key)}"
        for key in {**there, **here}
        if here.get(key) != there.get(key)
    ]
    return f" Cause: {', '.join(changed)}." if changed else ""


def _same_settings(
    cfg: DictConfig, record: dict[str, Any], folder: Path, task: torch.nn.Module
) -> None:
    there = record["config"]
    here: Any = OmegaConf.to_container(cfg, resolve=True)
    if (cfg.learn == "task") != (there["learn"] == "task"):
        raise UserError(
            f"{KEY}: {folder} was made with learn={there['learn']}; leave learn out. Samplers are "
            f"tested under a task net of your own with weights={weights.of_run(folder)}."
        )
    if cfg.learn == "task" and cfg.weights != OF_RUN:
        raise UserError(f"{KEY}: {folder} is a task net itself; leave weights out.")
    for group in ("task",) if cfg.learn == "task" else ("task", "sampler"):
        old, new = there["names"][group], here["names"][group]
        if old != new:
            raise UserError(
                f"{KEY}: {folder} was trained with {group}={old}, got {group}={new}. "
                f"Leave {group} out, or name a run with {group}={new}."
            )
    weightless = not any(True for _ in task.parameters())
    if here["names"]["net"] != there["names"]["net"] and cfg.weights == OF_RUN and not weightless:
        raise UserError(
            f"{KEY}: the task net of {folder} is {there['names']['net']}; for "
            f"task/net={here['names']['net']} give its weights too: weights=auto or a file."
        )
    for key in sorted({*there["sampler"], *here["sampler"]}) if cfg.learn != "task" else ():
        old, new = there["sampler"].get(key), here["sampler"].get(key)
        if old != new:
            hint = "" if key != "m" else " Sizes of a net for many are chosen with sizes=[...]."
            raise UserError(
                f"{KEY}: sampler.{key} is {new} here and was {old} when {folder} was trained; "
                f"leave it out, or train a sampler with it.{hint}"
            )


def _covers(key: str, other: str) -> bool:
    """Return whether overriding ``key`` makes an earlier override of ``other`` void."""
    return other == key or other.startswith((f"{key}.", f"{key}/", f"{key.replace('/', '.')}."))
