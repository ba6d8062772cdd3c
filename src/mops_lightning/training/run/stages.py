"""The stages of a run whose parts are built: load weights, warm start, fit, test, save."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import lightning as L
from omegaconf import OmegaConf
from torch import nn

from mops_lightning.data.clouds import CloudDataset
from mops_lightning.data.loader import CloudLoader
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
from mops_lightning.training.run.build import Parts, augmentation
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
    task, cfg = parts.experiment.task, parts.cfg
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
        if name not in BY_RUN and path in before and before[path] != value:
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
    record, name = trained.record, trained.name
    own_data = record.dataset_fingerprint == dataset.fingerprint
    if task_net and not own_data:
        outputs = getattr(record, str(experiment.task.output_names), None)
        check_names(outputs, experiment.task, dataset, f"{KEY}: {name}")
    module = experiment.task if trained.trained_task_net else experiment.sampler
    assert module is not None  # learn=nothing builds a sampler
    has_weights = any(True for _ in experiment.task.parameters())
    try:
        content = weights.load_into(module, weights.of_run(trained.place))
        if task_net and has_weights and not trained.trained_task_net:
            if "task_weights" not in record.files:
                raise UserError("it comes without its task net. Give weights=FILE.")
            weights.load_into(experiment.task, weights.of_run(trained.place, "task_weights"))
    except UserError as error:
        raise UserError(f"{KEY}: {name} cannot be loaded: {error}") from None
    return Evaluated(
        run=name,
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
    task, sampler = parts.experiment.task, parts.experiment.sampler
    source = parts.experiment.recipe.warm_start
    if sampler is None or not source or parts.resumed is not None:
        return
    points = parts.dataset.train.points
    record.warm_start, text = warm_start_sampler(source, sampler, task.net, points)
    if parts.trainer.is_global_zero:
        print(f"Warm start: {text}.")


def fit(parts: Parts, record: RunRecord) -> None:
    """Train the learned parts, from the checkpoint if the run is resumed.

    Raises:
        UserError: too little data, or training that diverged.
    """
    cfg, trainer, experiment = parts.cfg, parts.trainer, parts.experiment
    recipe = experiment.recipe
    if recipe != Recipe():
        named = {"name": cfg.names.recipe, **asdict(recipe)}
        only_task = {"task_points": recipe.task_points}
        record.recipe = only_task if experiment.sampler is None else named
    resumed = parts.resumed.path if parts.resumed else None
    task, clouds = experiment.task, len(parts.train.labels)
    if clouds < 2 * trainer.world_size:
        raise UserError(
            f"val_fraction={cfg.val_fraction} leaves {clouds} training "
            f"{'cloud' if clouds == 1 else 'clouds'}; "
            "at least two are needed for each device. Lower it, or give more data."
        )
    loader = CloudLoader(
        parts.train,
        cfg.batch_size,
        shuffle=not cfg.trainer.get("overfit_batches"),  # the same first batches in every epoch
        augment=augmentation(cfg),
        make_batch=task.make_batch,
        drop_last=True,
        seed=cfg.seed,
        part=parts.part,
    )
    validation = parts.score_loader(parts.held_out) if len(parts.held_out.labels) else None
    with _interruptible():
        trainer.fit(experiment, loader, validation, ckpt_path=resumed)
    check_finite(dict(experiment.state_dict()), trainer.global_step, trainer.strategy)
    record.seconds["fit_cpu"] = round(callback_of(trainer, CPUTime).seconds, 3)
    note_training(trainer, len(loader), record)
    show_profile(parts.folder, "fit")
    record.validation = dict(callback_of(trainer, KeepsEnding).validation(trainer))
    if parts.resumed and parts.resumed.steps == trainer.global_step and trainer.is_global_zero:
        print(
            f"{parts.resumed.path}: this training had ended after {parts.resumed.done} epochs; "
            "nothing was added to it."
        )


def callback_of(trainer: L.Trainer, kind: type[Kind]) -> Kind:
    """Return the trainer's first callback of a class, which it must have."""
    callbacks: Any = trainer.callbacks  # type: ignore[attr-defined]
    return next(callback for callback in callbacks if isinstance(callback, kind))


def test(parts: Parts, record: RunRecord) -> None:
    """Score all test clouds."""
    experiment, trainer = parts.experiment, parts.trainer
    loader = parts.score_loader(parts.dataset.test)
    with _interruptible():
        trainer.test(experiment, loader, verbose=False)
    note_test(trainer, len(loader), record)
    show_profile(parts.folder, "test")
    record.metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
    parsed = {name: parse_metric_name(name) for name in record.metrics}
    scores = {  # of every readout, at the run's own size
        name: record.metrics[name]
        for name, key in parsed.items()
        if key and key.metric == experiment.task.score and key.m in (None, experiment.m)
    }
    log_test(trainer, record, scores)
    if experiment.learn in ("sampler", "nothing") and parts.has_task_weights:
        # A resumed run has its task net from the checkpoint, not from a weights file.
        record.task_weights_sha256 = weights.digest(experiment.task.state_dict())


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
        judged = name == parts.experiment.score_name or name.split("/")[-2] == "loss"
        if judged and not math.isfinite(value):
            if parts.trains:
                raise Diverged(f"training diverged: {name} is {value}.")
            raise UserError(f"{name} is {value}. Check the data and the weights.")


def save(parts: Parts, record: RunRecord) -> None:
    """Record the files and scores of the run, and save the trained weights."""
    cfg, experiment = parts.cfg, parts.experiment
    task, sampler = experiment.task, experiment.sampler
    for kind, name in OUTPUTS.items():
        if (parts.folder / name).exists():
            record.files[kind] = name
    record.score = record.metrics.get(experiment.score_name)
    record.collapsed = {str(m): count for m, count in collapsed(record).items()}
    modules: dict[str, nn.Module | None] = {"task": task, "sampler": sampler}
    record.score_name = experiment.score_name
    record.metric_info = foreign_metrics(task.metrics().items())
    record.processes = parts.trainer.world_size
    record.parameters = {
        name: sum(parameter.numel() for parameter in module.parameters())
        for name, module in modules.items()
        if module is not None
    }
    _check_scores(parts, record.metrics)
    if not parts.trains:
        return
    files = {weights.FILE: task if cfg.learn == "task" else sampler}
    if cfg.learn != "task" and parts.has_task_weights:
        files[f"task_{weights.FILE}"] = task
    for name, module in files.items():
        assert module is not None  # only learn=task has no sampler
        outputs = task.output_names if module is task else None
        names = getattr(parts.dataset, outputs) if outputs else ()
        weights.save(parts.folder / name, module, record.config, record.metrics, names)
        record.files[Path(name).stem] = name
