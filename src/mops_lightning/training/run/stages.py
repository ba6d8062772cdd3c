"""The stages of a run whose parts are built: load weights, warm start, fit, test, save."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import lightning as L
from omegaconf import OmegaConf
from torch import nn

from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.nets.by_run import BY_RUN
from mops_lightning.records.collapse import collapsed
from mops_lightning.records.metric_info import foreign_metrics
from mops_lightning.records.readout_names import parse_metric_name
from mops_lightning.records.run_record import Evaluated, RunRecord
from mops_lightning.training.checkpoint import Diverged, check_finite
from mops_lightning.training.evaluation import KEY, OF_RUN, TrainedRun
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.training.recipe.warm_start import warm_start_sampler
from mops_lightning.training.run.build import Parts, has_weights
from mops_lightning.training.run.callbacks import CPUTime
from mops_lightning.training.run.ending import KeepsEnding
from mops_lightning.training.run.partial import (
    note_evaluated,
    note_task_net,
    note_test,
    note_training,
)
from mops_lightning.training.run.trainer import PROFILE, log_test, show_profile
from mops_lightning.tree import dotted
from mops_lightning.viz.figures import CLOUDS
from mops_lightning.zoo import weights
from mops_lightning.zoo.outputs import check_names

Kind = TypeVar("Kind")
OUTPUTS = {
    "checkpoint": "checkpoints/last.ckpt",
    "pictures": "pictures",
    "clouds": f"pictures/{CLOUDS}",
    "profile_fit": f"fit-{PROFILE}.txt",
    "profile_test": f"test-{PROFILE}.txt",
}
"""Files and folders that callbacks and loggers may have written."""


def load_weights(parts: Parts, record: RunRecord, task_weights: Path | None) -> None:
    """Load the weights of the task net and of an evaluated run.

    Raises:
        UserError: they do not fit.
    """
    if task_weights is not None:
        _load_task_net(parts, record, task_weights)
    if parts.trained is not None:
        of_run = parts.cfg.weights == OF_RUN
        record.evaluated = load_trained(parts.trained, of_run, parts.experiment, parts.dataset)
        note_evaluated(parts.trained.name, parts.trained.record, record)


def _load_task_net(parts: Parts, record: RunRecord, path: Path) -> None:
    """Load the task net from a file, and say in which settings its training differed."""
    task = parts.experiment.task
    cfg = parts.cfg
    is_start = cfg.learn == "task" and cfg.weights == "auto"
    setting = "pretrain_from" if is_start else "weights"
    try:
        content = weights.load_into(task, path)
    except UserError as error:
        raise UserError(f"{setting}: {error}") from None
    record.weights_loaded = content["sha256"]
    if content.get("classes"):
        check_names(content["classes"], task, parts.dataset, f"{setting}: {path}")
    net: Any = OmegaConf.to_container(cfg.task.net, resolve=True)
    different = _different_net(content["config"], net)
    if different and parts.trainer.is_global_zero:
        print(f"{setting}: {path} was trained with {', '.join(different)}, not as here.")
    note_task_net(content["config"], record)


def _different_net(recorded: dict[str, Any], net: dict[str, Any]) -> list[str]:
    """Return the recorded settings of a task net that differ from the present ones.

    Args:
        recorded: the configuration of the run that trained the net.
        net: the present settings of the net.
    """
    before = dotted(recorded)
    different = []
    for name, value in dotted(net).items():
        path = f"task.net.{name}"
        if name in BY_RUN or path not in before:
            continue
        if before[path] != value:
            different.append(f"{path}={before[path]}")
    return different


def load_trained(
    trained: TrainedRun, task_net: bool, experiment: Experiment, dataset: CloudDataset
) -> Evaluated:
    """Load the nets of a trained run into an experiment.

    Args:
        trained: the run.
        task_net: whether the run's task net is loaded, if it has weights.
        experiment: to fill.
        dataset: that is tested.

    Returns:
        The run and how it was trained, for the record.

    Raises:
        UserError: settings, classes or files do not match the run.
    """
    record = trained.record
    task = experiment.task
    is_own_data = record.dataset_fingerprint == dataset.fingerprint
    if task_net and not is_own_data:
        outputs = getattr(record, str(task.output_names), None)
        check_names(outputs, task, dataset, f"{KEY}: {trained.name}")
    module = task if trained.trained_task_net else experiment.sampler
    assert module is not None  # learn=nothing builds a sampler
    needs_task_net = task_net and not trained.trained_task_net and has_weights(task)
    try:
        content = weights.load_into(module, weights.of_run(trained.place))
        if needs_task_net:
            if "task_weights" not in record.files:
                raise UserError("it comes without its task net. Give weights=FILE.")
            weights.load_into(task, weights.of_run(trained.place, "task_weights"))
    except UserError as error:
        raise UserError(f"{KEY}: {trained.name} cannot be loaded: {error}") from None
    return Evaluated(
        run=trained.name,
        commit=record.git["commit"],
        max_epochs=record.config["trainer"]["max_epochs"],
        learn=record.config["learn"],
        recipe=record.recipe,
        seed=record.seed,
        dataset=record.config["names"]["dataset"],
        weights_sha256=content["sha256"],
    )


def warm_start(parts: Parts, record: RunRecord) -> None:
    """Start the sampler from copies of other weights, unless the run is resumed."""
    sampler = parts.experiment.sampler
    source = parts.experiment.recipe.warm_start
    if sampler is None or not source or parts.resumed is not None:
        return
    net = parts.experiment.task.net
    points = parts.dataset.train.points
    record.warm_start, text = warm_start_sampler(source, sampler, net, points)
    if parts.trainer.is_global_zero:
        print(f"Warm start: {text}.")


def fit(parts: Parts, record: RunRecord) -> None:
    """Train the learned parts, from the checkpoint if the run is resumed.

    Raises:
        UserError: too little data, or training that diverged.
    """
    trainer = parts.trainer
    experiment = parts.experiment
    resumed = parts.resumed
    record.recipe = _recipe_in_force(parts)
    _check_enough_clouds(parts)
    loader = parts.train_loader()
    validation = parts.score_loader(parts.held_out) if len(parts.held_out.labels) else None
    checkpoint = None if resumed is None else resumed.path
    with _interruptible():
        trainer.fit(experiment, loader, validation, ckpt_path=checkpoint)
    check_finite(dict(experiment.state_dict()), trainer.global_step, trainer.strategy)
    record.seconds["fit_cpu"] = round(callback_of(trainer, CPUTime).seconds, 3)
    note_training(trainer, len(loader), record)
    show_profile(parts.folder, "fit")
    record.validation = dict(callback_of(trainer, KeepsEnding).validation(trainer))
    if resumed is None or resumed.steps != trainer.global_step:
        return
    if trainer.is_global_zero:
        print(
            f"{resumed.path}: this training had ended after {resumed.done} epochs; "
            "nothing was added to it."
        )


def _recipe_in_force(parts: Parts) -> dict[str, Any] | None:
    """Return the recipe of the training for the record; None for the paper's."""
    recipe = parts.experiment.recipe
    if recipe == Recipe():
        return None
    if parts.experiment.sampler is None:
        return {"task_points": recipe.task_points}
    return {"name": parts.cfg.names.recipe, **asdict(recipe)}


def _check_enough_clouds(parts: Parts) -> None:
    """Refuse a training with fewer than two clouds for each device.

    Raises:
        UserError: there are too few.
    """
    clouds = len(parts.train.labels)
    if clouds >= 2 * parts.trainer.world_size:
        return
    noun = "cloud" if clouds == 1 else "clouds"
    raise UserError(
        f"val_fraction={parts.cfg.val_fraction} leaves {clouds} training {noun}; "
        "at least two are needed for each device. Lower it, or give more data."
    )


def callback_of(trainer: L.Trainer, kind: type[Kind]) -> Kind:
    """Return the trainer's first callback of a class, which it must have."""
    callbacks: Any = trainer.callbacks  # type: ignore[attr-defined]
    return next(callback for callback in callbacks if isinstance(callback, kind))


def test(parts: Parts, record: RunRecord) -> None:
    """Score all test clouds."""
    experiment = parts.experiment
    trainer = parts.trainer
    loader = parts.score_loader(parts.dataset.test)
    with _interruptible():
        trainer.test(experiment, loader, verbose=False)
    note_test(trainer, len(loader), record)
    show_profile(parts.folder, "test")
    record.metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
    log_test(trainer, record, _main_scores(experiment, record.metrics))
    if experiment.learn in ("sampler", "nothing") and parts.has_task_weights:
        # A resumed run has its task net from the checkpoint, not from a weights file.
        record.task_weights_sha256 = weights.digest(experiment.task.state_dict())


def _main_scores(experiment: Experiment, metrics: Mapping[str, float]) -> dict[str, float]:
    """Return the scores of all readouts at the run's own size, by log key."""
    scores = {}
    for name, value in metrics.items():
        key = parse_metric_name(name)
        if key is None or key.metric != experiment.task.score:
            continue
        if key.m in (None, experiment.m):
            scores[name] = value
    return scores


@contextmanager
def _interruptible() -> Iterator[None]:
    """Raise ``Interrupted`` for Ctrl-C, which Lightning turns into ``SystemExit``."""
    try:
        yield
    except SystemExit:
        raise Interrupted("Resume with the same command and ckpt_path=last.") from None


def _check_scores(parts: Parts, metrics: dict[str, float]) -> None:
    """Refuse a test whose score or losses are not finite, though the weights are."""
    for name, value in metrics.items():
        is_loss = name.split("/")[-2] == "loss"
        is_judged = is_loss or name == parts.experiment.score_name
        if is_judged and not math.isfinite(value):
            if parts.trains:
                raise Diverged(f"training diverged: {name} is {value}.")
            raise UserError(f"{name} is {value}. Check the data and the weights.")


def save(parts: Parts, record: RunRecord) -> None:
    """Record the files and scores of the run, and save the trained weights."""
    experiment = parts.experiment
    for kind, name in OUTPUTS.items():
        if (parts.folder / name).exists():
            record.files[kind] = name
    record.score = record.metrics.get(experiment.score_name)
    record.collapsed = {str(m): count for m, count in collapsed(record).items()}
    record.score_name = experiment.score_name
    record.metric_info = foreign_metrics(experiment.task.metrics().items())
    record.processes = parts.trainer.world_size
    record.parameters = {"task": _size(experiment.task)}
    if experiment.sampler is not None:
        record.parameters["sampler"] = _size(experiment.sampler)
    _check_scores(parts, record.metrics)
    if parts.trains:
        _save_weights(parts, record)


def _size(module: nn.Module) -> int:
    """Return the number of parameters."""
    return sum(parameter.numel() for parameter in module.parameters())


def _save_weights(parts: Parts, record: RunRecord) -> None:
    """Save the weights of the trained net, and beside a sampler's those of its task net."""
    task = parts.experiment.task
    sampler = parts.experiment.sampler
    files: dict[str, nn.Module] = {}
    if sampler is None:
        files[weights.FILE] = task
    else:
        files[weights.FILE] = sampler
        if parts.has_task_weights:
            files[f"task_{weights.FILE}"] = task
    for name, module in files.items():
        classes: tuple[str, ...] = ()
        if module is task and task.output_names:
            classes = getattr(parts.dataset, task.output_names)
        path = parts.folder / name
        channels = parts.dataset.channels
        weights.save(path, module, record.config, record.metrics, classes, channels)
        record.files[Path(name).stem] = name
