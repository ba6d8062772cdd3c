"""A quiet trainer, small data, and what changed in a module."""

import copy
from typing import Any

import lightning as L
import torch

from mops_lightning.data.clouds import CloudDataset, Clouds

SIDES = torch.tensor(
    [
        [1.0, 0.1, 0.1],
        [0.1, 1.0, 0.1],
        [0.3, 0.3, 0.3],
    ]
)
"""Standard deviation of a blob along each axis, by label."""


def quiet_trainer(epochs: int, **extra: Any) -> L.Trainer:
    """A CPU trainer that writes and prints nothing."""
    settings = {
        "accelerator": "cpu",
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "enable_checkpointing": False,
        "logger": False,
        "num_sanity_val_steps": 0,
        **extra,
    }
    return L.Trainer(max_epochs=epochs, **settings)


def small_dataset(train: int = 24, test: int = 10, points: int = 48) -> CloudDataset:
    """Three kinds of Gaussian blobs: enough to run every code path, too easy to measure with."""
    rng = torch.Generator().manual_seed(3)

    def clouds(number: int) -> Clouds:
        labels = torch.arange(number) % 3
        sides = SIDES[labels]
        blobs = torch.randn(number, points, 3, generator=rng) * sides[:, None]
        parts = blobs[..., 0] > 0
        return Clouds(blobs, labels, parts=parts.long())

    names = ("long", "tall", "round")
    parts = ("left", "right")
    return CloudDataset(names, clouds(train), clouds(test), "blobs", part_names=parts)


def changed(before, module):
    after = module.state_dict()
    return {name for name in before if not torch.equal(before[name], after[name])}


def state(module):
    return copy.deepcopy(module.state_dict())
