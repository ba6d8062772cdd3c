"""The stages of a run after its weights are loaded: warm start, fit, test, save."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch import nn

from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.records.metric_info import foreign_metrics
from mops_lightning.records.readout_names import parse_metric_name
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.divergence import Diverged, with_checkpoint
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.training.recipe.warm_start import warm_start_sampler
from mops_lightning.training.run.build import Parts, augmentation
from mops_lightning.training.run.callbacks import CPUTime
from mops_lightning.training.run.trainer import log_hparams
from mops_lightning.viz.snapshots import CLOUDS
from mops_lightning.zoo import weights

OUTPUTS = {
    "checkpoint": "checkpoints/last.ckpt",
    "pictures": "pictures",
    "clouds": f"pictures/{CLOUDS}",
    "tensorboard": "tensorboard",
}
"""Files and folders that callbacks and loggers may have written."""


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
        shuffle=True,
        augment=augmentation(cfg),
        make_batch=task.make_batch,
        drop_last=True,
        seed=cfg.seed,
        part=parts.part,
    )
    validation = parts.score_loader(parts.held_out) if len(parts.held_out.labels) else None
    try:
        with _interruptible(), _monitoring():
            trainer.fit(experiment, loader, validation, ckpt_path=resumed)
        if name := weights.first_nonfinite(experiment.state_dict()):
            raise Diverged(f"training diverged: {name} is not finite.")
    except Diverged as error:
        raise with_checkpoint(error, _last_checkpoint(parts)) from None
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        if resumed is None or experiment.started or isinstance(error, UserError):
            raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise weights.Damaged(f"ckpt_path: cannot resume from {resumed}: {reason}.") from error
    callbacks: Any = trainer.callbacks  # type: ignore[attr-defined]
    clock = next(one for one in callbacks if isinstance(one, CPUTime))
    record.seconds["fit_cpu"] = round(clock.seconds, 3)
    record.validation = {
        name: float(value)
        for name, value in trainer.callback_metrics.items()
        if name.startswith("val/")
    }


def _last_checkpoint(parts: Parts) -> Path | None:
    """Return the newest checkpoint of this run, or the one that it was resumed from."""
    own = parts.folder / OUTPUTS["checkpoint"]
    if own.is_file():
        return own
    return parts.resumed.path if parts.resumed else None


def test(parts: Parts, record: RunRecord) -> None:
    """Score all test clouds."""
    experiment, trainer = parts.experiment, parts.trainer
    with _interruptible():
        trainer.test(experiment, parts.score_loader(parts.dataset.test), verbose=False)
    record.metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
    parsed = {name: parse_metric_name(name) for name in record.metrics}
    scores = {  # of every readout, at the run's own size
        name: record.metrics[name]
        for name, key in parsed.items()
        if key and key.metric == experiment.task.score and key.m in (None, experiment.m)
    }
    log_hparams(trainer, record.config, scores)
    if experiment.learn in ("sampler", "nothing") and parts.has_task_weights:
        # A resumed run has its task net from the checkpoint, not from a weights file.
        record.task_weights_sha256 = weights.digest(experiment.task.state_dict())


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


def _check_scores(parts: Parts, metrics: dict[str, float]) -> None:
    """Refuse a test whose score or losses are not finite, though the weights are."""
    score = parts.experiment.score_name
    judged = [name for name in metrics if name == score or name.split("/")[-2] == "loss"]
    bad = [name for name in judged if not math.isfinite(metrics[name])]
    if not bad:
        return
    text = f"{bad[0]} is {metrics[bad[0]]}"
    if not parts.trains:
        raise UserError(f"{text}. Check the data and the weights.")
    error = UserError(f"training diverged: {text}.")
    raise with_checkpoint(error, _last_checkpoint(parts))


def save(parts: Parts, record: RunRecord) -> None:
    """Record the files and scores of the run, and save the trained weights."""
    cfg, experiment = parts.cfg, parts.experiment
    task, sampler = experiment.task, experiment.sampler
    for kind, name in OUTPUTS.items():
        if (parts.folder / name).exists():
            record.files[kind] = name
    record.score = record.metrics[experiment.score_name]
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
    if cfg.learn == "joint":
        files[f"task_{weights.FILE}"] = task
    for name, module in files.items():
        assert module is not None  # only learn=task has no sampler
        classes = parts.dataset.class_names if module is task and task.requires_same_classes else ()
        weights.save(parts.folder / name, module, record.config, record.metrics, classes)
        record.files[Path(name).stem] = name
