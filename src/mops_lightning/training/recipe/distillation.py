"""Losses that compare the frozen task net's outputs for a sample and for the whole cloud."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from mops_lightning.data.clouds import Clouds
from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write, remove_temporary
from mops_lightning.tasks.base import Task
from mops_lightning.training.checkpoint import read_plain
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.types import Batch, PointFeatureNet
from mops_lightning.zoo import weights


class Targets(NamedTuple):
    """Outputs of the frozen task net for all points; None for outputs that are not compared."""

    prediction: Any
    features: Tensor | None


class Distillation:
    """The recipe's two distillation losses of one experiment.

    Args:
        task: with the frozen task net.
        recipe: for the weights of the losses.
        clouds: whose predictions are computed once; None: they are computed in every step.
    """

    def __init__(self, task: Task, recipe: Recipe, clouds: "FullClouds | None" = None) -> None:
        self.task = task
        self.recipe = recipe
        self.predicts = recipe.distillation > 0
        self.clouds = clouds if self.predicts and task.clouds_are_batches else None
        self.table: Tensor | None = None

    def start(self, device: torch.device) -> None:
        """Read or compute the predictions for all points of every training cloud.

        Not earlier, because a resumed run has its task net from the checkpoint.
        """
        if self.clouds is not None:
            self.table = full_predictions(self.task, self.clouds, device)

    @torch.no_grad()
    def targets(self, batch: Batch, seen: Tensor) -> Targets:
        """Return what samples are compared with.

        Args:
            batch: whose points the prediction is of.
            seen: ``(B, N, 3)`` the points that the step sees, whose features are pooled.
        """
        compares_features = self.recipe.feature_distillation > 0
        return Targets(
            self._prediction(batch) if self.predicts else None,
            pooled_features(self.task.net, seen) if compares_features else None,
        )

    def _prediction(self, batch: Batch) -> Any:
        if self.table is None or batch.rows is None:
            return self.task.predict(batch, batch.points)
        self.table = self.table.to(batch.rows.device)
        return self.table[batch.rows]

    def losses(self, points: Tensor, output: Any, targets: Targets) -> dict[str, Tensor]:
        """Return the weighted losses of a sample.

        Args:
            points: ``(B, M, 3)`` the sample.
            output: the task net's output for it.
            targets: see ``targets``.
        """
        losses = {}
        if targets.prediction is not None:
            apart = self.task.disagreement(output, targets.prediction).mean()
            losses["distillation"] = self.recipe.distillation * apart
        if targets.features is not None:
            apart = feature_distance(pooled_features(self.task.net, points), targets.features)
            losses["feature_distillation"] = self.recipe.feature_distillation * apart
        return losses


def pooled_features(net: nn.Module, points: Tensor) -> Tensor:
    """Return the task net's features ``(B, C)`` of clouds ``(B, N, 3)``: maxima over the points.

    Raises:
        UserError: the net has none.
    """
    if not isinstance(net, PointFeatureNet):
        raise UserError(
            "recipe.feature_distillation must be 0 with a task net that has no features of single "
            f"points under a maximum (point_features), got {type(net).__name__}."
        )
    return net.point_features(points).amax(1)


def feature_distance(features: Tensor, reference: Tensor) -> Tensor:
    """Return ‖f − r‖² / ‖r‖², the mean over clouds, of pooled features ``(B, C)``."""
    apart = (features - reference).square().sum(1)
    return (apart / reference.square().sum(1).clamp_min(1e-12)).mean()


@dataclass(frozen=True)
class FullClouds:
    """The training clouds, without augmentation, whose predictions are kept in a file.

    Attributes:
        clouds: in the order of their rows in a batch.
        batch_size: clouds per batch.
        cache: folder for the file.
    """

    clouds: Clouds
    batch_size: int
    cache: Path

    def __deepcopy__(self, memo: dict[int, Any]) -> "FullClouds":
        """Return itself: the moving average copies the experiment, but needs no clouds."""
        return self


def full_predictions(task: Task, full: FullClouds, device: torch.device) -> Tensor:
    """Return the predictions of a task whose batches are the clouds themselves.

    They are kept in a file, which is named by the weights and the clouds.

    Args:
        task: in evaluation mode; its net is moved to ``device``.
        full: the clouds.
        device: where to compute.

    Returns:
        One row per cloud, on the CPU; see ``Task.predict``.
    """
    named = hashlib.sha256(weights.digest(task.state_dict()).encode())
    named.update(full.clouds.points.numpy().tobytes())
    path = full.cache / "predictions" / f"{named.hexdigest()[:16]}.pt"
    if path.is_file():
        kept: Tensor = read_plain(path, "predictions")
        return kept
    predictions = _predict(task, full, device)
    remove_temporary(path.parent, below=False)
    with atomic_write(path) as temporary:
        torch.save(predictions, temporary)
    return predictions


@torch.no_grad()
def _predict(task: Task, full: FullClouds, device: torch.device) -> Tensor:
    task.to(device)
    parts = []
    for batch in CloudLoader(full.clouds, full.batch_size):
        points = batch.points.to(device)
        parts.append(task.predict(batch._replace(points=points), points).cpu())
    return torch.cat(parts)
