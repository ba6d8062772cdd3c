"""The stages of a run whose parts are built: load weights, warm start, fit, test, save."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import lightning as L
import torch
from torch import nn

from mops_lightning.errors import Interrupted, UserError
from mops_lightning.records.collapse import collapsed
from mops_lightning.records.metric_info import foreign_metrics
from mops_lightning.records.readout_names import parse_metric_name
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.checkpoint import Checkpoint, Diverged, check_finite
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.training.recipe.warm_start import warm_start_sampler
from mops_lightning.training.run.callbacks import CPUTime, KeepsStart
from mops_lightning.training.run.ending import KeepsEnding
from mops_lightning.training.run.load import load_weights
from mops_lightning.training.run.loggers import finish_loggers, log_test
from mops_lightning.training.run.partial import (
    note_test,
    note_training,
)
from mops_lightning.training.run.parts import Parts
from mops_lightning.training.run.trainer import PROFILE, show_profile
from mops_lightning.viz.figures import CLOUDS
from mops_lightning.zoo import weights

Kind = TypeVar("Kind")
OUTPUTS = {
    "checkpoint": "checkpoints/last.ckpt",
    "pictures": "pictures",
    "clouds": f"pictures/{CLOUDS}",
    "profile_fit": f"fit-{PROFILE}.txt",
    "profile_test": f"test-{PROFILE}.txt",
}
"""Files and folders that callbacks and loggers may have written."""


def train_and_test(parts: Parts, record: RunRecord, task_weights: Path | None) -> None:
    """Run all stages in their order.

    Args:
        parts: the parts of the run.
        record: the run's record, which is filled.
        task_weights: a file for the task net; None leaves it as initialised.
    """
    load_weights(parts, record, task_weights)
    try:
        if parts.trains:
            warm_start(parts, record)
            with record.timed("fit"):
                fit(parts, record)
        with record.timed("test"):
            test(parts, record)
        if parts.trainer.is_global_zero:
            save(parts, record)
    except Diverged as error:
        text = f"{error} No weights were saved."
        if parts.last_checkpoint:
            text += f" The last finite checkpoint is {parts.last_checkpoint}."
        text += " Try a lower learning rate (optimizer.lr) or other weights of the losses."
        raise UserError(text) from None
    finally:
        finish_loggers(parts.trainer)


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
    record.recipe = _recorded_recipe(parts)
    _check_enough_clouds(parts)
    loader = parts.train_loader()
    validation = None
    if len(parts.held_out.labels) > 0:
        validation = parts.score_loader(parts.held_out)
    start = callback_of(trainer, KeepsStart)
    start.note(record)
    checkpoint = None
    if resumed is not None:
        checkpoint = resumed.path
        _warn_of_other_threads(resumed, trainer)
    with _interruptible():
        trainer.fit(experiment, loader, validation, ckpt_path=checkpoint)
    start.fill(record)
    check_finite(dict(experiment.state_dict()), trainer.global_step, trainer.strategy)
    record.seconds["fit_cpu"] = round(callback_of(trainer, CPUTime).seconds, 3)
    note_training(trainer, len(loader), record)
    show_profile(parts.folder, "fit")
    record.validation = dict(callback_of(trainer, KeepsEnding).validation(trainer))
    if resumed is not None and trainer.is_global_zero and resumed.steps == trainer.global_step:
        print(
            f"{resumed.path}: this training had ended after {resumed.done} epochs; "
            "nothing was added to it."
        )


def _warn_of_other_threads(resumed: Checkpoint, trainer: L.Trainer) -> None:
    """Say that a resumed training will differ, because sums are rounded in another order."""
    threads = torch.get_num_threads()
    if resumed.threads in (None, threads) or not trainer.is_global_zero:
        return
    print(
        f"{resumed.path}: this training began with OMP_NUM_THREADS={resumed.threads} and goes on "
        f"with {threads}. Rounding differs, and so does its result."
    )


def _recorded_recipe(parts: Parts) -> dict[str, Any] | None:
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


def save(parts: Parts, record: RunRecord) -> None:
    """Record the scores and files of the run, and save the trained weights.

    Raises:
        Diverged: a score or a loss of the trained nets is not finite.
        UserError: one of given nets is not finite.
    """
    _record_results(parts, record)
    _check_scores(parts, record.metrics)
    if parts.trains:
        _save_weights(parts, record)


def _record_results(parts: Parts, record: RunRecord) -> None:
    """Add the scores, the files of callbacks and loggers, and the nets' sizes to the record."""
    experiment = parts.experiment
    for kind, name in OUTPUTS.items():
        if (parts.folder / name).exists():
            record.files[kind] = name
    record.score = record.metrics.get(experiment.score_name)
    record.score_name = experiment.score_name
    record.collapsed = {str(m): count for m, count in collapsed(record).items()}
    record.metric_info = foreign_metrics(experiment.task.metrics().items())
    record.processes = parts.trainer.world_size
    record.parameters = {"task": _number_of_parameters(experiment.task)}
    if experiment.sampler is not None:
        record.parameters["sampler"] = _number_of_parameters(experiment.sampler)


def _check_scores(parts: Parts, metrics: Mapping[str, float]) -> None:
    """Refuse a test whose score or losses are not finite, though the weights are."""
    for name, value in metrics.items():
        is_loss = name.split("/")[-2:-1] == ["loss"]  # callbacks log names without a slash
        is_score = name == parts.experiment.score_name
        if math.isfinite(value) or not (is_loss or is_score):
            continue
        if parts.trains:
            raise Diverged(f"training diverged: {name} is {value}.")
        raise UserError(f"{name} is {value}. Check the data and the weights.")


def _number_of_parameters(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def _save_weights(parts: Parts, record: RunRecord) -> None:
    """Save the weights of the trained net, and of the task net of a trained sampler."""
    task = parts.experiment.task
    sampler = parts.experiment.sampler
    classes: tuple[str, ...] = ()
    if task.output_names:
        classes = getattr(parts.dataset, task.output_names)
    if sampler is None:
        _save_net(task, weights.FILE, classes, parts, record)
        return
    _save_net(sampler, weights.FILE, (), parts, record)
    if parts.has_task_weights:
        _save_net(task, f"task_{weights.FILE}", classes, parts, record)


def _save_net(
    net: nn.Module, name: str, classes: tuple[str, ...], parts: Parts, record: RunRecord
) -> None:
    """Save a net in the run's folder under a name, with the names of its classes."""
    path = parts.folder / name
    channels = parts.dataset.channels
    weights.save(path, net, record.config, record.metrics, classes, channels)
    record.files[path.stem] = name
