"""Losses that compare the frozen task net's outputs for a sample and for the whole cloud."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.tasks.base import Task
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.types import Batch, PointFeatureNet


@dataclass(frozen=True)
class Targets:
    """The targets of distillation in one step: samples are compared with them.

    Attributes:
        prediction: the first task net's for all points; None if it is not compared.
        seen: ``(B, N, 3)`` the points that the step sees, whose features are pooled.
        features: number of a task net → its pooled features, filled for the nets that are used.
    """

    prediction: Any
    seen: Tensor
    features: dict[int, Tensor] = field(default_factory=dict)


class Distillation:
    """The recipe's two distillation losses of one experiment, for each of its frozen task nets.

    Args:
        tasks: with one task net each; all are compared with the first one's predictions.
        recipe: gives the weights of the losses.
    """

    def __init__(self, tasks: Sequence[Task], recipe: Recipe) -> None:
        self.tasks = tasks
        self.recipe = recipe
        self.predicts = recipe.distillation > 0
        self.table: Tensor | None = None

    def start(self, loader: Any, device: torch.device, dtype: torch.dtype) -> None:
        """Compute the predictions for all points of every training cloud, if they stay the same.

        They do unless clouds are augmented or converted to pairs; then each step computes those of
        its batch. Not earlier, because a resumed run has its task net from the checkpoint.

        Args:
            loader: the loader of the training clouds.
            device: where to compute.
            dtype: dtype of the nets, which ``trainer.precision`` may lower.
        """
        fixed = isinstance(loader, CloudLoader) and loader.keeps_clouds
        if self.predicts and fixed:
            self.table = full_predictions(self.tasks[0], loader, device, dtype)

    @torch.no_grad()
    def targets(self, batch: Batch, seen: Tensor) -> Targets:
        """Return what samples are compared with.

        Args:
            batch: whose points the prediction is of.
            seen: see ``Targets``.
        """
        prediction = None
        if self.table is not None and batch.rows is not None:
            prediction = self.table[batch.rows]
        elif self.predicts:
            prediction = self.tasks[0].predict(batch, batch.points)
        return Targets(prediction, seen)

    def losses(
        self, number: int, points: Tensor, output: Any, targets: Targets
    ) -> dict[str, Tensor]:
        """Return the weighted losses of a sample under one task net.

        Args:
            number: number of the task net.
            points: ``(B, M, 3)`` the sample.
            output: the task net's output for it.
            targets: see ``targets``.
        """
        losses = {}
        task = self.tasks[number]
        if targets.prediction is not None:
            apart = task.disagreement(output, targets.prediction).mean()
            losses["distillation"] = self.recipe.distillation * apart
        if self.recipe.feature_distillation:
            if number not in targets.features:
                with torch.no_grad():
                    targets.features[number] = pooled_features(task.net, targets.seen)
            features = pooled_features(task.net, points)
            apart = feature_distance(features, targets.features[number])
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


@torch.no_grad()
def full_predictions(
    task: Task, loader: CloudLoader, device: torch.device, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Return the predictions for all points of a loader's clouds.

    Args:
        task: in evaluation mode, on ``device``.
        loader: a loader that does not change its clouds.
        device: where to compute.
        dtype: dtype of the task net.

    Returns:
        One row per cloud, in the order of ``Batch.rows``; see ``Task.predict``.
    """
    parts = []
    for batch in CloudLoader(loader.clouds, loader.batch_size):
        points = batch.points.to(device, dtype)
        parts.append(task.predict(batch._replace(points=points), points))
    return torch.cat(parts)
