"""Build what a configuration describes, fit it and test it."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Checkpoint, ProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from mops_lightning.config.build import accepted, build
from mops_lightning.data.clouds import CloudDataset, Clouds
from mops_lightning.data.loader import Augmentation, CloudLoader
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.records.readout_names import parse
from mops_lightning.records.run_record import dotted
from mops_lightning.seeding import derive_seed, generator
from mops_lightning.tasks.base import Task
from mops_lightning.training.callbacks import CHECKPOINT, build_callbacks
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.malloc import keep_freed_memory
from mops_lightning.training.sizes import sizes_to_test

HARMLESS = (
    ".*does not have many workers.*",  # the data lie in memory; workers would only copy them
    ".*no `val_dataloader`.*",  # val_fraction=0 is a choice
    ".*dirpath has changed.*",  # a resumed run has a folder of its own
    ".*module.s. in eval mode at the start.*",  # frozen parts are meant to be
    ".*smaller than the logging interval.*",  # it is lowered for small data sets
    ".*isinstance.treespec, LeafSpec.*",  # Lightning 2.6 calls an old name of torch 2.13
    ".*GPU available but not used.*",  # trainer=cpu is a choice
    ".*AMP with fp16 is not supported on CPU.*",  # an error says so
)
"""Warnings about what is meant to be so."""


def fit(
    cfg: DictConfig,
    trainer: L.Trainer,
    experiment: Experiment,
    dataset: CloudDataset,
    checkpoint: Path | None,
) -> None:
    """Train what learns, from ``checkpoint`` on if there is one."""
    part = trainer.global_rank, trainer.world_size
    train, held_out = split(dataset.train, cfg.val_fraction, cfg.seed)
    if len(train.labels) < 2 * trainer.world_size:
        raise UserError(
            f"val_fraction={cfg.val_fraction} leaves {len(train.labels)} training clouds; "
            "at least two are needed for each device. Lower it, or give more data."
        )
    loader = CloudLoader(
        train,
        cfg.batch_size,
        shuffle=True,
        augment=Augmentation(**cfg.augment[cfg.learn]),
        make_batch=experiment.task.make_batch,
        drop_last=True,
        seed=cfg.seed,
        part=part,
    )
    validation = None
    if len(held_out.labels):
        validation = _scored(held_out, cfg.batch_size, experiment.task, part)
    # A small data set has fewer batches than lie between two logged ones.
    every = min(trainer.log_every_n_steps, len(loader))  # type: ignore[attr-defined]
    trainer.log_every_n_steps = every  # type: ignore[attr-defined]
    with _interruptible():
        trainer.fit(experiment, loader, validation, ckpt_path=checkpoint)


def test(
    cfg: DictConfig, trainer: L.Trainer, experiment: Experiment, dataset: CloudDataset
) -> dict[str, float]:
    """Score all test clouds and return the metrics as one flat map."""
    with _interruptible():
        part = trainer.global_rank, trainer.world_size
        loader = _scored(dataset.test, cfg.batch_size, experiment.task, part)
        trainer.test(experiment, loader, verbose=False)
    metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
    log_hparams(trainer, cfg, _headline(metrics, experiment))
    return metrics


def _scored(
    clouds: Clouds, batch_size: int, task: Task, part: tuple[int, int] = (0, 1)
) -> CloudLoader:
    """Return a loader whose batches are the same in every epoch and for every method."""
    return CloudLoader(
        clouds, batch_size, make_batch=task.make_batch, seed=task.test_seed, part=part
    )


def _headline(metrics: dict[str, float], experiment: Experiment) -> dict[str, float]:
    """Pick the task's score at every readout, of several sizes at the run's own."""
    chosen = {}
    for name, value in metrics.items():
        parts = parse(name)
        if parts and parts.metric == experiment.task.score and parts.m in (None, experiment.m):
            chosen[name] = value
    return chosen


@contextmanager
def _interruptible() -> Iterator[None]:
    """Undo Lightning's translation of Ctrl-C into SystemExit."""
    try:
        yield
    except SystemExit:
        raise Interrupted("Go on with the same command and ckpt_path=last.") from None


def make_experiment(cfg: DictConfig, dataset: CloudDataset, identity: dict[str, str]) -> Experiment:
    """Build task, sampler and baselines, each from a seed of its own."""
    classes = len(dataset.class_names)
    L.seed_everything(derive_seed(cfg.seed, 0) % 2**32, verbose=False)
    offered = {"num_classes": classes}
    net = build(cfg.task.net, "task.net", **accepted(cfg.task.net, offered))
    task: Task = build(cfg.task, "task", net=net, **accepted(cfg.task, offered))
    # A seed of its own: the sampler's first weights must not hang on the size of the task net.
    L.seed_everything(derive_seed(cfg.seed, 1) % 2**32, verbose=False)
    sampler = build(cfg.sampler, "sampler") if cfg.learn != "task" else None
    points = task.points_of(dataset.test.points.shape[1])
    sizes = sizes_to_test(cfg.sizes, cfg.m, sampler, points, training=cfg.learn != "nothing")
    baselines = {}
    if sampler is not None and sampler.learned:
        nodes = {str(name): node for name, node in cfg.baselines.items() if node}
        baselines = {
            name: build(node, f"baselines.{name}", m=max(sizes)) for name, node in nodes.items()
        }
    elif sampler is not None and sampler.flexible:
        sampler = build(cfg.sampler, "sampler", m=max(sizes))
    return Experiment(
        task,
        sampler,
        learn=cfg.learn,
        make_optimizer=build(cfg.optimizer.optimizer, "optimizer.optimizer"),
        make_schedule=build(cfg.optimizer.schedule, "optimizer.schedule"),
        baselines=baselines,
        seed=cfg.seed,
        identity=identity,
        sizes=sizes,
        m=cfg.m,
        task_rate=cfg.task_rate,
    )


def make_trainer(cfg: DictConfig, folder: Path, dataset: CloudDataset, task: Task) -> L.Trainer:
    """Build the trainer with this run's callbacks and logger."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        # Under Hydra each line would come twice, once from Lightning's own handler.
        logging.getLogger(name).handlers.clear()
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in HARMLESS:
        warnings.filterwarnings("ignore", message=message)
    keep_freed_memory()
    logger = build(cfg.logger, "logger", save_dir=str(folder)) if cfg.get("logger") else False
    score = task.score if cfg.learn != "task" else task.full_score or task.score
    offered = {"folder": folder, "checkpoint": folder / "checkpoints" / CHECKPOINT, "score": score}
    rows, titles = choose_shown(dataset, cfg.pictures)
    if titles:
        batch = _scored(dataset.test, cfg.batch_size, task).batch_of(rows)
        offered |= {"batch": batch, "titles": titles}
    callbacks = build_callbacks(cfg.callbacks, offered, logged=bool(logger))
    trainer: L.Trainer = build(
        cfg.trainer,
        "trainer",
        logger=logger,
        callbacks=callbacks,
        default_root_dir=str(folder),
        num_sanity_val_steps=0,
        enable_model_summary=False,
        enable_checkpointing=any(isinstance(callback, Checkpoint) for callback in callbacks),
        enable_progress_bar=any(isinstance(callback, ProgressBar) for callback in callbacks),
    )
    if cfg.trainer.get("precision") == "16-mixed" and trainer.precision != "16-mixed":
        raise UserError(
            "trainer.precision=16-mixed needs a GPU, and there is none here: take bf16-mixed."
        )
    return trainer


def choose_shown(dataset: CloudDataset, number: int) -> tuple[Tensor, list[str]]:
    """Return rows of test clouds of different classes, spread over all classes, and their names."""
    labels = dataset.test.labels
    wanted = torch.linspace(0, len(dataset.class_names) - 1, max(number, 1)).round().long()
    rows = [int((labels == label).nonzero()[0]) for label in wanted.unique() if label in labels]
    rows = rows[:number]
    names = [dataset.class_names[int(labels[row])] for row in rows]
    return torch.tensor(rows, dtype=torch.int64), names


def log_hparams(trainer: L.Trainer, cfg: DictConfig, metrics: dict[str, float]) -> None:
    """Give the logger the settings that tell runs apart, with the test metrics beside them."""
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    keys = ("names", "sampler", "optimizer", "augment", "m", "learn", "seed", "batch_size")
    leaves = dotted({key: plain[key] for key in keys})
    flat = {key: value for key, value in leaves.items() if key.rsplit(".", 1)[-1][:1] != "_"}
    flat["max_epochs"] = plain["trainer"]["max_epochs"]
    if isinstance(trainer.logger, TensorBoardLogger):
        trainer.logger.log_hyperparams(flat, {f"hparams/{k}": v for k, v in metrics.items()})
        # Lightning has closed it after the test; this opened it again, with a thread of its own.
        trainer.logger.finalize("success")
    elif trainer.logger is not None:
        trainer.logger.log_hyperparams(flat)


def device_name(trainer: L.Trainer) -> str:
    """Return the GPU's name, or the kind of device."""
    root = trainer.strategy.root_device
    return torch.cuda.get_device_name(root) if root.type == "cuda" else root.type


def held_out_clouds(clouds: Clouds, fraction: float) -> int:
    """Return how many training clouds ``split`` holds out."""
    return round(len(clouds.labels) * fraction)


def split(clouds: Clouds, fraction: float, seed: int) -> tuple[Clouds, Clouds]:
    """Hold out a random share of the training clouds for the curves under ``val/``."""
    held_out = held_out_clouds(clouds, fraction)
    order = torch.randperm(len(clouds.labels), generator=generator(seed, 2))
    rest, chosen = order[held_out:].sort().values, order[:held_out].sort().values
    return (
        Clouds(clouds.points[rest], clouds.labels[rest]),
        Clouds(clouds.points[chosen], clouds.labels[chosen]),
    )
