"""Losses that compare what the frozen task net makes of a sample and of the whole cloud."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError
from mops_lightning.tasks.base import Task
from mops_lightning.training.recipe import Recipe
from mops_lightning.types import Batch, PointFeatureNet


class Targets(NamedTuple):
    """What the frozen task net makes of all points; None for what is not compared."""

    prediction: Any
    features: Tensor | None


class Distillation:
    """The recipe's two distillation losses of one experiment.

    Args:
        task: with the frozen task net.
        recipe: for the weights of the losses.

    Attributes:
        predicts: whether predictions are compared.
        table: the predictions for all points of every training cloud; None: they are computed in
            every step.
    """

    def __init__(self, task: Task, recipe: Recipe) -> None:
        self.task = task
        self.recipe = recipe
        self.predicts = recipe.distillation > 0
        self.table: Tensor | None = None

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


def feature_distance(found: Tensor, reference: Tensor) -> Tensor:
    """Return ‖f − r‖² / ‖r‖², the mean over clouds, of pooled features ``(B, C)``."""
    apart = (found - reference).square().sum(1)
    return (apart / reference.square().sum(1).clamp_min(1e-12)).mean()
