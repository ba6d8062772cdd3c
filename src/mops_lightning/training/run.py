"""One run: compose → build → pretrain if needed → fit → test → result.json."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mops_lightning.config import distributed
from mops_lightning.config.build import build
from mops_lightning.config.validate import check
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.data.noise import noisy
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.records import run_record
from mops_lightning.records.metric_info import described
from mops_lightning.records.summary import closing_lines
from mops_lightning.training import checkpoint, evaluate, pretrain
from mops_lightning.training.trainer import (
    device_name,
    fit,
    held_out_clouds,
    make_experiment,
    make_trainer,
    test,
)
from mops_lightning.viz.snapshots import CLOUDS
from mops_lightning.zoo import weights

STARTED = ".started"
"""Empty file in the folder of a run that has begun."""

OUTPUTS = {
    "checkpoint": "checkpoints/last.ckpt",
    "pictures": "pictures",
    "clouds": f"pictures/{CLOUDS}",
    "tensorboard": "tensorboard",
}
"""What callbacks and loggers may have written."""


def run(cfg: DictConfig, folder: Path, overrides: list[str] | None = None) -> dict[str, Any]:
    """Do all that a configuration asks for and leave ``result.json`` in ``folder``.

    Args:
        cfg: a composed configuration.
        folder: the run's folder; must not hold a result yet.
        overrides: what the user changed, for the record.

    Returns:
        The record, as written.

    Raises:
        UserError: a mistake in settings or files.
    """
    check(cfg)
    follows = distributed.is_worker_rank(cfg)
    if not follows:
        _begin(folder)
    with recorded(cfg, folder, overrides or []) as record:
        with timed(record, "data"):
            dataset = build(cfg.dataset, "dataset")
            test_points = noisy(dataset.test.points, cfg.noise)
            dataset = replace(dataset, test=dataset.test._replace(points=test_points))
        points = dataset.train.points.shape[1]
        if cfg.m > points:
            raise UserError(f"m must be at most the {points} points of a cloud, got m={cfg.m}.")
        fit_and_test(cfg, folder, dataset, record)
    if not follows:
        closing_lines(folder, record)
    return record


def _begin(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    try:
        # Two runs that start in the same second get the same folder; the second one stops here.
        (folder / STARTED).touch(exist_ok=False)
    except FileExistsError:
        raise UserError(
            f"{folder} holds another run and nothing is overwritten: start again for a new folder, "
            "and leave hydra.run.dir out or give another one."
        ) from None


def fit_and_test(
    cfg: DictConfig, folder: Path, dataset: CloudDataset, record: dict[str, Any]
) -> None:
    """Train and score what ``cfg`` says on loaded data, and fill the record."""
    identity = checkpoint.identity(cfg, dataset.fingerprint)
    resumed = checkpoint.find(cfg, identity)
    record["notes"] |= {
        "dataset_fingerprint": dataset.fingerprint,
        "train_clouds": len(dataset.train.labels),
        "test_clouds": len(dataset.test.labels),
        "class_names": list(dataset.class_names),
        "resumed_from": None if resumed is None else str(resumed),
        "lengthened": resumed is not None and checkpoint.lengthened(cfg, resumed),
        **dataset.notes,
    }
    experiment = make_experiment(cfg, dataset, identity)
    task = experiment.task
    trainer = make_trainer(cfg, folder, dataset, task)
    distributed.check_shares(
        cfg.batch_size,
        len(dataset.test.labels),
        held_out_clouds(dataset.train, cfg.val_fraction),
        trainer.world_size,
    )
    has_weights = any(True for _ in task.parameters())
    task_weights = None
    if not has_weights and cfg.weights not in (None, "auto", evaluate.OF_RUN):
        raise UserError(
            f"weights: {cfg.names.net} has none to load, got {cfg.weights}. Leave weights out."
        )
    if has_weights:
        with timed(record, "pretrain"):
            task_weights = pretrain.task_weights(cfg, dataset)
    if task_weights is not None:
        content = weights.load_into(task, task_weights)
        record["notes"]["weights_loaded"] = content["sha256"]
        if task.requires_same_classes and content.get("classes"):
            evaluate.same_classes(content["classes"], dataset, f"weights: {task_weights}")
    if cfg.evaluate:
        record["notes"]["evaluated"] = evaluate.load(cfg, experiment, dataset)
    elif cfg.learn == "nothing" and experiment.sampler is not None and experiment.sampler.learned:
        raise UserError("learn=nothing needs a trained sampler: give its run with evaluate=RUN.")
    record["device"] = device_name(trainer)
    trains = experiment.trainable and not cfg.evaluate
    if trains:
        with timed(record, "fit"):
            fit(cfg, trainer, experiment, dataset, resumed)
    if cfg.learn in ("sampler", "nothing") and has_weights:
        # A resumed run has its task net from the checkpoint, not from a weights file.
        record["notes"]["task_weights_sha256"] = weights.digest(task.state_dict())
    with timed(record, "test"):
        record["metrics"] = test(cfg, trainer, experiment, dataset)
    if not trainer.is_global_zero:
        return  # all that follows is written, and once is enough
    for kind, name in OUTPUTS.items():
        if (folder / name).exists():
            record["files"][kind] = name
    record["score"] = record["metrics"][experiment.score_name]
    record["notes"] |= {
        "score": experiment.score_name,
        "metrics": described(task.metrics().items()),
        "processes": trainer.world_size,
        "parameters": {
            name: sum(parameter.numel() for parameter in module.parameters())
            for name, module in (("task", task), ("sampler", experiment.sampler))
            if module is not None
        },
    }
    if not math.isfinite(record["score"]):
        raise UserError(
            f"{experiment.score_name} is {record['score']}: the training went astray, and nothing "
            "of it is kept. Try a lower rate (optimizer.optimizer.lr) or other weights of losses."
        )
    learned: dict[str, dict[str, Any]] = {
        "task": {weights.FILE: task},
        "sampler": {weights.FILE: experiment.sampler},
    }
    learned["joint"] = {**learned["sampler"], "task_weights.pt": task}
    if trains:
        for name, module in learned[cfg.learn].items():
            classes = dataset.class_names if module is task and task.requires_same_classes else ()
            weights.save(folder / name, module, record["config"], record["metrics"], classes)
            record["files"][Path(name).stem] = name
    # Each of several devices has BatchNorm's statistics of its own share.
    anew = not record["notes"]["lengthened"] and cfg.weights in (None, "auto")
    anew = anew and trainer.world_size == 1
    if cfg.learn == "task" and trains and anew:
        pretrain.publish(cfg, folder / weights.FILE, dataset)


@contextmanager
def recorded(cfg: DictConfig, folder: Path, overrides: list[str]) -> Iterator[dict[str, Any]]:
    """Keep ``result.json`` true while the block runs, and give its record to be filled.

    A process that follows another one fills its record for nobody.
    """
    plain = OmegaConf.to_container(cfg, resolve=True)
    record: dict[str, Any] = {
        "schema": run_record.SCHEMA,
        "status": "running",
        "config": plain,
        "overrides": overrides,
        "metrics": {},
        "score": None,
        "seconds": {},
        "seed": cfg.seed,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        **run_record.environment(),
        "device": None,
        "files": {},
        "error": None,
        "notes": {},
    }
    write = (lambda *_: None) if distributed.is_worker_rank(cfg) else run_record.write
    write(folder, record)
    try:
        with timed(record, "total"):
            yield record
        record["status"] = "completed"
    except (KeyboardInterrupt, Interrupted) as stop:
        record["status"], record["error"] = "interrupted", str(stop) or "interrupted"
        raise
    except BaseException as error:
        record["status"], record["error"] = "failed", f"{type(error).__name__}: {error}"
        raise
    finally:
        write(folder, record)


@contextmanager
def timed(record: dict[str, Any], name: str) -> Iterator[None]:
    """Note how many seconds the block took."""
    start = time.perf_counter()
    try:
        yield
    finally:
        record["seconds"][name] = round(time.perf_counter() - start, 3)
