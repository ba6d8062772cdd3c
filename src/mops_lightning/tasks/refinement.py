"""The refined readout: samples improved by asking the frozen task net."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.refine import refine
from mops_lightning.tasks.base import Task
from mops_lightning.types import PooledNet

BATCH_POINTS = 32768
"""Number of points whose features are in memory together; at least one cloud."""


class Refinement:
    """Exchanges points of samples so that the task net predicts nearly what it does for all points.

    It needs no labels, but runs the task net on the full cloud: scores of refined samples are a
    bound for what m input points can give this net. See ``ops.refine`` for the search.

    Args:
        task: its ``disagreement`` is minimised; the net is used as it is, in evaluation mode.
        refine: largest number of passes over the places of a sample.

    Raises:
        UserError: the prediction does not follow from the maxima of a sample's features.
    """

    def __init__(self, task: Task, refine: int) -> None:
        name = type(task).__name__.lower()
        if type(task).predict_pooled is Task.predict_pooled:
            raise UserError(
                f"refine must be 0 for {name}, got {refine}: its prediction depends on more than "
                "the features of one sample. Only classification and reconstruction refine."
            )
        if not isinstance(task.net, PooledNet):
            raise UserError(
                f"refine must be 0 with {type(task.net).__name__}, got {refine}: this net has no "
                "features of single points under a maximum. Choose another task net, such as "
                "pointnet."
            )
        self.task = task
        self.passes = refine

    def __call__(self, batch: Any, samples: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """Refine the samples of a batch.

        Args:
            batch: clouds ``(B, N, 3)``.
            samples: by size m, distinct rows ``(B, m)`` of the clouds.

        Returns:
            The same sizes with other rows ``(B, m)``, distinct.
        """
        # Lightning tests in inference mode, whose tensors cannot be differentiated.
        with torch.inference_mode(False), torch.no_grad():
            parts = []
            count = max(1, BATCH_POINTS // batch.points.shape[1])
            for start in range(0, len(batch.points), count):
                chosen = slice(start, start + count)
                part = batch._replace(points=batch.points[chosen].clone())
                rows = {m: indices[chosen].clone() for m, indices in samples.items()}
                parts.append(self._refined(part, rows))
        return {m: torch.cat([part[m] for part in parts]) for m in samples}

    def _refined(self, batch: Any, samples: Mapping[int, Tensor]) -> dict[int, Tensor]:
        net = self.task.net
        assert isinstance(net, PooledNet)
        features = net.point_features(batch.points)
        wanted = self.task.predict_pooled(batch, features.amax(1))

        def apart(pooled: Tensor, cloud: Tensor) -> Tensor:
            return self.task.disagreement(self.task.predict_pooled(batch, pooled), wanted[cloud])

        return {m: refine(features, rows, apart, self.passes) for m, rows in samples.items()}
