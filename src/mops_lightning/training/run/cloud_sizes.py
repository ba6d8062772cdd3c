"""Clouds of different sizes: the smallest of them, and what cannot take them."""

from collections.abc import Sequence

import torch
from torch import Tensor

from mops_lightning.data.clouds import CloudDataset, Clouds
from mops_lightning.data.loader import CloudLoader, MakeBatch
from mops_lightning.errors import UserError


def check_processes(dataset: CloudDataset, processes: int) -> None:
    """Refuse clouds of different sizes for several processes, which share every batch."""
    has_train_sizes = dataset.train.sizes is not None
    has_test_sizes = dataset.test.sizes is not None
    differ = has_train_sizes or has_test_sizes
    if differ and processes > 1:
        raise UserError(
            f"trainer.devices must be 1 with clouds of different sizes, got {processes}. Or set "
            "dataset.n_points to a number."
        )


def smallest_cloud(splits: Sequence[Clouds], make_batch: MakeBatch | None) -> Tensor:
    """Return the cloud ``(1, N, 3 + C)`` with the fewest points, as a sampler gets it."""
    smallest = min(splits, key=lambda clouds: clouds.smallest[1])
    # Pairs may have fewer points than the clouds they are drawn from.
    loader = CloudLoader(smallest, 1, make_batch=make_batch)
    row, _ = smallest.smallest
    batch = loader.batch_of(torch.tensor([row]))
    cloud: Tensor = batch.points[:1]
    return cloud
