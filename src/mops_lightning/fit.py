"""Build what a configuration describes, fit it and test it."""

import logging
import warnings
from pathlib import Path
from typing import Any

import lightning as L
import torch
from omegaconf import DictConfig

from mops_lightning import callbacks
from mops_lightning.config import build
from mops_lightning.data.clouds import CloudDataset, Clouds
from mops_lightning.data.loader import Augmentation, CloudLoader
from mops_lightning.experiment import Experiment
from mops_lightning.seeding import derive_seed, generator


def fit(
    cfg: DictConfig,
    trainer: L.Trainer,
    experiment: Experiment,
    dataset: CloudDataset,
    checkpoint: Path | None,
) -> None:
    """Train what learns, from ``checkpoint`` on if there is one."""
    train, held_out = split(dataset.train, cfg.val_fraction, cfg.seed)
    loader = CloudLoader(
        train,
        cfg.batch_size,
        shuffle=True,
        augment=Augmentation(**cfg.augment[cfg.learn]),
        drop_last=True,
        seed=cfg.seed,
    )
    validation = CloudLoader(held_out, cfg.batch_size) if len(held_out.labels) else None
    trainer.fit(experiment, loader, validation, ckpt_path=checkpoint)


def test(
    cfg: DictConfig, trainer: L.Trainer, experiment: Experiment, dataset: CloudDataset
) -> dict[str, float]:
    """Score all test clouds and return the metrics as one flat map."""
    trainer.test(experiment, CloudLoader(dataset.test, cfg.batch_size), verbose=False)
    return {name: float(value) for name, value in trainer.callback_metrics.items()}


def make_experiment(
    cfg: DictConfig, dataset: CloudDataset, identity: dict[str, str]
) -> Experiment:
    """Build task, sampler and baselines, each from a seed of its own."""
    classes = len(dataset.class_names)
    L.seed_everything(derive_seed(cfg.seed, 0) % 2**32, verbose=False)
    net = build(cfg.task.net, num_classes=classes)
    task = build(cfg.task, net=net, num_classes=classes)
    # A seed of its own: the sampler's first weights must not hang on the size of the task net.
    L.seed_everything(derive_seed(cfg.seed, 1) % 2**32, verbose=False)
    sampler = build(cfg.sampler) if cfg.learn != "task" else None
    baselines = {}
    if sampler is not None and sampler.learned:
        baselines = {str(name): build(node) for name, node in cfg.baselines.items() if node}
    return Experiment(
        task,
        sampler,
        learn=cfg.learn,
        make_optimizer=build(cfg.optimizer.optimizer),
        make_schedule=build(cfg.optimizer.schedule),
        baselines=baselines,
        seed=cfg.seed,
        identity=identity,
    )


def make_trainer(cfg: DictConfig, folder: Path) -> L.Trainer:
    """Build the trainer with this run's callbacks and logger."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        # Under Hydra each line would come twice, once from Lightning's own handler.
        logging.getLogger(name).handlers.clear()
        logging.getLogger(name).setLevel(logging.WARNING)
    # Our loader has no workers on purpose: the data lie in memory.
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    logger = build(cfg.logger, save_dir=str(folder)) if cfg.get("logger") else False
    return build(
        cfg.trainer,
        logger=logger,
        callbacks=callbacks.standard(folder),
        default_root_dir=str(folder),
        num_sanity_val_steps=0,
        enable_model_summary=False,
    )


def device_name(trainer: L.Trainer) -> str:
    """Return the GPU's name, or the kind of device."""
    root = trainer.strategy.root_device
    return torch.cuda.get_device_name(root) if root.type == "cuda" else root.type


def split(clouds: Clouds, fraction: float, seed: int) -> tuple[Clouds, Clouds]:
    """Hold out a random share of the training clouds for the curves under ``val/``."""
    held_out = round(len(clouds.labels) * fraction)
    order = torch.randperm(len(clouds.labels), generator=generator(seed, 2))
    rest, chosen = order[held_out:].sort().values, order[:held_out].sort().values
    return (
        Clouds(clouds.points[rest], clouds.labels[rest]),
        Clouds(clouds.points[chosen], clouds.labels[chosen]),
    )
