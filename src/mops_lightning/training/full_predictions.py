"""What the frozen task net predicts for all points of every training cloud, computed once."""

import hashlib
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from mops_lightning.data.clouds import Clouds
from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write, remove_temporary
from mops_lightning.tasks.base import Task
from mops_lightning.zoo import weights


class FullPredictions(Callback):
    """Gives an experiment's distillation the table when training starts.

    Not earlier, because a resumed run has its task net from the checkpoint.

    Args:
        clouds: the training clouds, without augmentation.
        batch_size: clouds per batch.
        cache: folder for the file.
    """

    def __init__(self, clouds: Clouds, batch_size: int, cache: Path) -> None:
        self.clouds = clouds
        self.batch_size = batch_size
        self.cache = cache

    def on_train_start(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Read or compute the table."""
        pl_module.distillation.table = full_predictions(
            pl_module.task, self.clouds, self.batch_size, self.cache, pl_module.device
        )


def full_predictions(
    task: Task, clouds: Clouds, batch_size: int, cache: Path, device: torch.device
) -> Tensor:
    """Return the predictions of a task whose batches are the clouds themselves.

    They are kept in a file, which is named by the weights and the clouds.

    Args:
        task: in evaluation mode; its net is moved to ``device``.
        clouds: the training clouds, without augmentation.
        batch_size: clouds per batch.
        cache: folder for the file.
        device: where to compute.

    Returns:
        One row per cloud, on the CPU; see ``Task.predict``.
    """
    named = hashlib.sha256(weights.digest(task.state_dict()).encode())
    named.update(clouds.points.numpy().tobytes())
    path = cache / "predictions" / f"{named.hexdigest()[:16]}.pt"
    found = _read(path, len(clouds.points))
    if found is None:
        found = _predict(task, clouds, batch_size, device)
        remove_temporary(path.parent, below=False)
        with atomic_write(path) as temporary:
            torch.save(found, temporary)
    return found


def _read(path: Path, rows: int) -> Tensor | None:
    """Return what was kept; None if there is nothing usable."""
    if not path.is_file():
        return None
    try:
        kept = weights.read_plain(path, "predictions")
    except UserError:
        return None
    usable = isinstance(kept, Tensor) and len(kept) == rows and bool(kept.isfinite().all())
    return kept if usable else None


@torch.no_grad()
def _predict(task: Task, clouds: Clouds, batch_size: int, device: torch.device) -> Tensor:
    task.to(device)
    parts = []
    for batch in CloudLoader(clouds, batch_size):
        points = batch.points.to(device)
        parts.append(task.predict(batch._replace(points=points), points).cpu())
    return torch.cat(parts)
