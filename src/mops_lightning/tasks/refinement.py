"""The refined readout: samples improved by local search with the frozen task net."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.refine import refine
from mops_lightning.tasks.base import Task
from mops_lightning.types import PointFeatureNet

BATCH_POINTS = 32768
"""Number of points of one side whose features are in memory together; at least one cloud."""


class Refinement:
    """Exchanges points of samples until the task net predicts nearly the same as for all points.

    It needs no labels, but runs the task net on the full cloud: scores of refined samples are a
    bound for what m input points can give this net. See ``ops.refine`` for the search. Where a
    prediction needs two clouds, the sources are refined for the whole targets, then the targets for
    the refined sources.

    Args:
        task: its ``disagreement`` is minimised; the net is used as it is, in evaluation mode.
        refine: largest number of passes over the places of a sample.

    Raises:
        UserError: the prediction does not follow from the maxima of a sample's features.
    """

    def __init__(self, task: Task, refine: int) -> None:
        if task.maps_pooled is None:
            raise UserError(
                f"refine must be 0 for {type(task).__name__.lower()}, got {refine}: its prediction "
                "does not follow from the features of a sample (maps_pooled)."
            )
        suits = isinstance(task.net, PointFeatureNet) and hasattr(task.net, task.maps_pooled)
        if not suits or not getattr(task.net, "pools_points", True):
            raise UserError(
                f"refine must be 0 with this {type(task.net).__name__}, got {refine}: its result "
                "does not follow from features of single points under a maximum. Such nets are "
                "pointnet for classification, pcrnet with iterations=1 for registration, and "
                "autoencoder, atlasnet or mfoldingnet for reconstruction."
            )
        self.task = task
        self.passes = refine

    def __call__(self, batch: Any, samples: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """Refine the samples of a batch.

        Args:
            batch: clouds ``(B, N, 3)``, or pairs of ``(2B, N, 3)``.
            samples: by size m, distinct rows ``(B, m)`` or ``(2B, m)`` of the clouds.

        Returns:
            The same sizes with other rows of the same shape, distinct.
        """
        # Lightning tests in inference mode, whose tensors cannot be differentiated.
        with torch.inference_mode(False), torch.no_grad():
            parts = []
            count = max(1, BATCH_POINTS // batch.points.shape[1])
            for start in range(0, batch.num_clouds, count):
                chosen = slice(start, start + count)
                sides = [side[chosen].clone() for side in self._sides(batch.points)]
                rows = {
                    m: [side[chosen].clone() for side in self._sides(indices)]
                    for m, indices in samples.items()
                }
                parts.append(self._refined(batch, sides, rows))
        order = range(self.task.clouds_per_prediction)
        return {m: torch.cat([part[m][side] for side in order for part in parts]) for m in samples}

    def _sides(self, tensor: Tensor) -> tuple[Tensor, ...]:
        """Split what all clouds have into the first clouds of the predictions, and so on."""
        return tensor.chunk(self.task.clouds_per_prediction)

    def _refined(
        self, batch: Any, sides: Sequence[Tensor], samples: Mapping[int, Sequence[Tensor]]
    ) -> dict[int, list[Tensor]]:
        net = self.task.net
        assert isinstance(net, PointFeatureNet)
        features = [net.point_features(points) for points in sides]
        whole = [each.amax(1) for each in features]
        wanted = predict_pooled(self.task, batch, torch.cat(whole))
        result: dict[int, list[Tensor]] = {}
        for m, rows in samples.items():
            # One side after the other; what is not refined yet is the whole cloud.
            pooled, result[m] = list(whole), []
            for side, (own, indices) in enumerate(zip(features, rows, strict=True)):
                apart = partial(self._apart, batch, wanted, pooled, side)
                refined = refine(own, indices, apart, self.passes)
                pooled[side] = gather_points(own, refined).amax(1)
                result[m].append(refined)
        return result

    def _apart(
        self,
        batch: Any,
        wanted: Any,
        pooled: Sequence[Tensor],
        side: int,
        candidates: Tensor,
        cloud: Tensor,
    ) -> Tensor:
        """Return the disagreement when one side has other pooled features ``(R, C)``."""
        both = [candidates if i == side else each[cloud] for i, each in enumerate(pooled)]
        found = predict_pooled(self.task, batch, torch.cat(both))
        return self.task.disagreement(found, _take(wanted, cloud))


def predict_pooled(task: Task, batch: Any, pooled: Tensor) -> Any:
    """Return the prediction of a task from maxima over the net's ``point_features``.

    Args:
        task: with ``maps_pooled``.
        batch: from ``make_batch``.
        pooled: ``(R, C)``, in the order of the points.
    """
    sizes = (batch.points.shape[1],) if "n_points" in task.net_takes else ()
    return getattr(task.net, str(task.maps_pooled))(
        *pooled.chunk(task.clouds_per_prediction), *sizes
    )


def _take(prediction: Any, rows: Tensor) -> Any:
    """Return rows of a prediction, a tensor or a tuple of tensors such as ``Motion``."""
    if isinstance(prediction, Tensor):
        return prediction[rows]
    return type(prediction)(*(part[rows] for part in prediction))
