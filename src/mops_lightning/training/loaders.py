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
    return CloudLoader(
        clouds, batch_size, make_batch=task.make_batch, seed=task.test_seed, part=part
    )


def augmentation(cfg: DictConfig) -> Any:
    """Return the augmentation settings of this run; joint training has the sampler's."""
    return cfg.augment.task if cfg.learn == "task" else cfg.augment.sampler


def num_held_out(clouds: Clouds, fraction: float) -> int:
    """Return how many training clouds ``split`` holds out."""
    return round(len(clouds.labels) * fraction)


def split(clouds: Clouds, fraction: float, seed: int) -> tuple[Clouds, Clouds]:
    """Hold out a random share of the training clouds for the curves under ``val/``.

    Returns:
        The clouds to train on and the held-out clouds, each in their original order.
    """
    held_out = num_held_out(clouds, fraction)
    order = torch.randperm(len(clouds.labels), generator=generator(seed, 2))
    rest, chosen = order[held_out:].sort().values, order[:held_out].sort().values
    return (
        Clouds(clouds.points[rest], clouds.labels[rest]),
        Clouds(clouds.points[chosen], clouds.labels[chosen]),
    )


def clouds_to_draw(dataset: CloudDataset, number: int) -> tuple[Tensor, list[str]]:
    """Choose test clouds of different classes, spread over all classes.

    Returns:
        Rows of the test split, at most ``number``, and the names of their classes.
    """
    labels = dataset.test.labels
    wanted = torch.linspace(0, len(dataset.class_names) - 1, max(number, 1)).round().long()
    rows = [int((labels == label).nonzero()[0]) for label in wanted.unique() if label in labels]
    rows = rows[:number]
    names = [dataset.class_names[int(labels[row])] for row in rows]
    return torch.tensor(rows, dtype=torch.int64), names
