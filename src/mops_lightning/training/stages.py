"""The stages of a run once its job is prepared: load weights, fit, test, save."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lightning.pytorch.callbacks import Callback
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch import nn

from mops_lightning.data.loader import Augmentation, CloudLoader
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.records.metric_info import foreign_metrics
from mops_lightning.records.readout_names import parse
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.divergence import Diverged, with_checkpoint
from mops_lightning.training.evaluation import nets
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.full_predictions import FullPredictions
from mops_lightning.training.job import Job
from mops_lightning.training.loaders import augmentation, score_loader, split
from mops_lightning.training.recipe import Recipe
from mops_lightning.training.trainer import log_hparams
from mops_lightning.training.warm_start import warm_start
from mops_lightning.viz.snapshots import CLOUDS
from mops_lightning.zoo import weights

OUTPUTS = {
    "checkpoint": "checkpoints/last.ckpt",
    "pictures": "pictures",
    "clouds": f"pictures/{CLOUDS}",
    "tensorboard": "tensorboard",
}
"""What callbacks and loggers may have written."""


def fit_and_test(job: Job, record: RunRecord, task_weights: Path | None) -> None:
    """Load weights, train what learns, score it, and save both.

    Args:
        job: from ``job.prepare``.
        record: is filled.
        task_weights: a file for the task net; None leaves it as initialised.

    Raises:
        UserError: weights that do not fit, too little data, or training that diverged.
    """
    _load_weights(job, record, task_weights)
    if job.trains:
        if job.experiment.recipe != Recipe():
            record.recipe = _recipe(job)
        warm_start(job, record)
        with record.timed("fit"):
            _fit(job)
        record.validation = {
            name: float(value)
            for name, value in job.trainer.callback_metrics.items()
            if name.startswith("val/")
        }
    if job.cfg.learn in ("sampler", "nothing") and job.has_task_weights:
        # A resumed run has its task net from the checkpoint, not from a weights file.
        digest = weights.digest(job.experiment.task.state_dict())
        record.task_weights_sha256 = digest
    with record.timed("test"):
        record.metrics = _test(job, record.config)
    if job.trainer.is_global_zero:
        _save(job, record)


def _recipe(job: Job) -> dict[str, Any]:
    recipe = job.experiment.recipe
    if job.experiment.sampler is None:
        return {"task_points": recipe.task_points}
    return {"name": job.cfg.names.recipe, **asdict(recipe)}


def _load_weights(job: Job, record: RunRecord, task_weights: Path | None) -> None:
    task = job.experiment.task
    if task_weights is not None:
        try:
            content = weights.read(task_weights)
            weights.fit_state(task, content["state"], task_weights)
        except UserError as error:
            raise UserError(f"weights: {error}") from None
        record.weights_loaded = content["sha256"]
        if task.requires_same_classes and content.get("classes"):
            nets.check_classes(content["classes"], job.dataset, f"weights: {task_weights}")
    if job.trained is not None:
        record.evaluated = nets.load(job.trained, job.cfg, job.experiment, job.dataset)


def _fit(job: Job) -> None:
    """Train what learns, from the checkpoint if the run is resumed."""
    cfg, trainer, experiment = job.cfg, job.trainer, job.experiment
    task = experiment.task
    train, held_out = split(job.dataset.train, cfg.val_fraction, cfg.seed)
    clouds = len(train.labels)
    if clouds < 2 * trainer.world_size:
        raise UserError(
            f"val_fraction={cfg.val_fraction} leaves {clouds} training "
            f"{'cloud' if clouds == 1 else 'clouds'}; "
            "at least two are needed for each device. Lower it, or give more data."
        )
    augment = Augmentation(**augmentation(cfg))
    loader = CloudLoader(
        train,
        cfg.batch_size,
        shuffle=True,
        augment=augment,
        make_batch=task.make_batch,
        drop_last=True,
        seed=cfg.seed,
        part=job.part,
    )
    distills = experiment.distillation is not None and experiment.distillation.predicts
    if distills and task.clouds_are_batches and not augment.active:
        cache = Path(cfg.cache).expanduser()
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        callbacks.insert(0, FullPredictions(train, cfg.batch_size, cache))
    validation = None
    if len(held_out.labels):
        validation = score_loader(held_out, cfg.batch_size, task, job.part)
    # An epoch of a small data set may be shorter than the logging interval.
    every = min(trainer.log_every_n_steps, len(loader))  # type: ignore[attr-defined]
    trainer.log_every_n_steps = every  # type: ignore[attr-defined]
    try:
        with _interruptible(), _monitoring():
            trainer.fit(job.experiment, loader, validation, ckpt_path=job.resumed)
        if name := weights.first_nonfinite(job.experiment.state_dict()):
            raise Diverged(f"training diverged: {name} is not finite.")
    except Diverged as error:
        raise with_checkpoint(error, _last_checkpoint(job)) from None
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        if job.resumed is None or job.experiment.started or isinstance(error, UserError):
            raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise weights.Damaged(f"ckpt_path: cannot resume from {job.resumed}: {reason}.") from error


def _last_checkpoint(job: Job) -> Path | None:
    """Return the newest checkpoint of this run, or the one that it was resumed from."""
    own = job.folder / OUTPUTS["checkpoint"]
    return own if own.is_file() else job.resumed


def _test(job: Job, config: dict[str, Any]) -> dict[str, float]:
    """Score all test clouds and return the metrics by name.

    Args:
        job: from ``job.prepare``.
        config: the settings as plain data, for the logger.
    """
    experiment, trainer = job.experiment, job.trainer
    with _interruptible():
        loader = score_loader(job.dataset.test, job.cfg.batch_size, experiment.task, job.part)
        trainer.test(experiment, loader, verbose=False)
    metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
    log_hparams(trainer, config, _scores_at_own_size(metrics, experiment))
    return metrics


def _scores_at_own_size(metrics: dict[str, float], experiment: Experiment) -> dict[str, float]:
    """Select the task's score of every readout, at the run's own size."""
    chosen = {}
    for name, value in metrics.items():
        parts = parse(name)
        if parts and parts.metric == experiment.task.score and parts.m in (None, experiment.m):
            chosen[name] = value
    return chosen


@contextmanager
def _interruptible() -> Iterator[None]:
    """Raise ``Interrupted`` where Lightning turns Ctrl-C into ``SystemExit``."""
    try:
        yield
    except SystemExit:
        raise Interrupted("Resume with the same command and ckpt_path=last.") from None


@contextmanager
def _monitoring() -> Iterator[None]:
    """Raise ``UserError`` where a callback of Lightning's monitors a metric that is not there."""
    try:
        yield
    except (RuntimeError, MisconfigurationException) as error:
        text = str(error)
        if not (text.startswith("Early stopping conditioned on metric") or "monitor=" in text):
            raise
        raise UserError(f"callbacks: {' '.join(text.split())}") from None


def _check_scores(job: Job, metrics: dict[str, float]) -> None:
    """Refuse a test whose score or losses are not finite, though the weights are."""
    score = job.experiment.score_name
    judged = [name for name in metrics if name == score or name.split("/")[-2] == "loss"]
    bad = [name for name in judged if not math.isfinite(metrics[name])]
    if not bad:
        return
    text = f"{bad[0]} is {metrics[bad[0]]}"
    if not job.trains:
        raise UserError(f"{text}. Check the data and the weights.")
    error = UserError(f"training diverged: {text}.")
    raise with_checkpoint(error, _last_checkpoint(job))


def _save(job: Job, record: RunRecord) -> None:
    """Fill in what the run wrote and scored, and save what it trained."""
    cfg, experiment = job.cfg, job.experiment
    task, sampler = experiment.task, experiment.sampler
    for kind, name in OUTPUTS.items():
        if (job.folder / name).exists():
            record.files[kind] = name
    record.score = record.metrics[experiment.score_name]
    parts: dict[str, nn.Module | None] = {"task": task, "sampler": sampler}
    record.score_name = experiment.score_name
    record.metric_info = foreign_metrics(task.metrics().items())
    record.processes = job.trainer.world_size
    record.parameters = {
        name: sum(parameter.numel() for parameter in module.parameters())
        for name, module in parts.items()
        if module is not None
    }
    _check_scores(job, record.metrics)
    if not job.trains:
        return
    files = {weights.FILE: task if cfg.learn == "task" else sampler}
    if cfg.learn == "joint":
        files[f"task_{weights.FILE}"] = task
    for name, module in files.items():
        assert module is not None  # only learn=task has no sampler
        classes = job.dataset.class_names if module is task and task.requires_same_classes else ()
        weights.save(job.folder / name, module, record.config, record.metrics, classes)
        record.files[Path(name).stem] = name
