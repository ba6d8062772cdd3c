"""Loaders of a run's clouds: for training, for ``val/`` and for the test."""

from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from mops_lightning.data.clouds import CloudDataset, Clouds
from mops_lightning.data.loader import CloudLoader
from mops_lightning.seeding import generator
from mops_lightning.tasks.base import Task


def score_loader(
    clouds: Clouds, batch_size: int, task: Task, part: tuple[int, int] = (0, 1)
) -> CloudLoader:
    """Return a loader whose batches are the same in every epoch and for every sampler.

    Args:
        clouds: what is scored.
        batch_size: clouds per batch, of all processes together.
        task: makes the batches.
        part: rank of this process and number of processes.
    """
    return CloudLoader(clouds, batch_size, make_batch=task.make_batch, part=part)


def augmentation(cfg: DictConfig) -> Any:
    """Return the augmentation settings of this run; joint training has the sampler's."""
    return cfg.augment.task if cfg.learn == "task" else cfg.augment.sampler


def held_out_mask(clouds: Clouds, fraction: float, seed: int) -> Tensor:
    """Return a mask ``(S,)`` of the training clouds that ``split`` holds out.

    Clouds of one source, such as the crops of a file, are held out together.
    """
    sources = clouds.sources
    if sources is None:
        sources = torch.arange(len(clouds.labels))
    names = sources.unique()
    order = torch.randperm(len(names), generator=generator(seed, 2))
    return torch.isin(sources, names[order[: round(len(names) * fraction)]])


def split(clouds: Clouds, fraction: float, seed: int) -> tuple[Clouds, Clouds]:
    """Hold out a random share of the training clouds for the curves under ``val/``.

    Returns:
        The clouds to train on and the held-out clouds, each in their original order.
    """
    chosen = held_out_mask(clouds, fraction, seed)
    return clouds.take(~chosen), clouds.take(chosen)


def clouds_to_draw(dataset: CloudDataset, number: int) -> tuple[Tensor, list[str]]:
    """Choose test clouds of different classes, spread over all classes.

    Returns:
        Rows of the test split, at most ``number``, and the names of their classes.
    """
    labels = dataset.test.labels
    classes = len(dataset.class_names)
    wanted = torch.linspace(0, classes - 1, min(max(number, 1), classes)).round().long()
    rows = [int((labels == label).nonzero()[0]) for label in wanted.unique() if label in labels]
    rows = rows[:number]
    names = [dataset.class_names[int(labels[row])] for row in rows]
    return torch.tensor(rows, dtype=torch.int64), names
