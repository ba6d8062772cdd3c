"""Segmentation of whole clouds into parts, from their sampled points."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor, nn
from torch.nn import functional as F
from torchmetrics import MetricCollection

from mops_lightning.channels import coordinates
from mops_lightning.errors import UserError, check_at_least
from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import MeanIoU, PointAccuracy
from mops_lightning.ops.propagation import interpolate
from mops_lightning.tasks.base import Task, figures_of
from mops_lightning.tasks.classification import divergence
from mops_lightning.types import UNKNOWN, Batch, TaskOutput

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Segmentation(Task):
    """Names the part of every point of a cloud, though the net sees the sampled points only.

    The logits of the sampled points are interpolated to all points of the cloud, see
    ``ops.propagation.interpolate``. Loss and metrics are over all points whose part is known.

    Args:
        net: maps ``(B, M, 3)`` points to ``(B, M, num_parts)`` logits.
        num_parts: number of parts.
        k: number of sampled points that a point's logits are interpolated from.

    Raises:
        UserError: there are fewer than two parts, or ``k`` is below 1.
    """

    score = MeanIoU.name
    output_names = "part_names"

    def __init__(self, net: nn.Module, num_parts: int, k: int = 3) -> None:
        super().__init__(net)
        check_at_least(2, num_parts=num_parts)
        check_at_least(1, k=k)
        self.num_parts = num_parts
        self.k = k

    def predict(self, batch: Batch, points: Tensor) -> Tensor:
        """Return the logits ``(B, N, num_parts)`` of all points from ``(B, M, 3)`` sampled ones."""
        logits = self.net(points)
        if points is batch.points:  # every point is its own nearest one
            return logits
        places = coordinates(points)
        return interpolate(logits, places, coordinates(batch.points), self.k)

    def disagreement(self, found: Tensor, reference: Tensor) -> Tensor:
        """Return KL(reference ‖ found), the mean over the points of a cloud."""
        return divergence(found, reference).mean(1)

    def step(self, batch: Batch, points: Tensor) -> TaskOutput:
        """Segment one batch.

        Args:
            batch: the clouds and the parts ``(B, N)`` of their points, ``UNKNOWN`` without one.
            points: ``(B, M, 3)`` sampled from the clouds.

        Returns:
            The cross entropy, the losses of samplers inside the net, predicted parts ``(B, N)``
            and parts.

        Raises:
            UserError: the batch has no parts.
        """
        if batch.parts is None:
            raise UserError("segmentation needs clouds whose points have parts, got none.")
        logits = self.predict(batch, points)
        # The mean of F.cross_entropy would be 0/0 for a batch without a known part.
        total = F.cross_entropy(logits.mT, batch.parts, ignore_index=UNKNOWN, reduction="sum")
        number_known = (batch.parts != UNKNOWN).sum()
        losses = {"cross_entropy": total / number_known.clamp(min=1)}
        losses |= getattr(self.net, "losses", {})
        return TaskOutput(losses, logits.argmax(2), batch.parts, logits)

    def metrics(self, training: bool = False) -> MetricCollection:
        """Return mean intersection over union of the parts and accuracy, both in [0, 1]."""
        mean_iou = MeanIoU(self.num_parts, ignore_index=UNKNOWN)
        return collection(mean_iou, PointAccuracy(self.num_parts, ignore_index=UNKNOWN))


@figures_of.register(Segmentation)
def _(
    task: Segmentation,
    batch: Batch,
    samples: Mapping[str, Tensor],
    titles: Sequence[str],
) -> "dict[str, Figure]":
    """Draw the true parts, and those predicted from the points of every readout."""
    from mops_lightning.viz.task_results import part_grid

    assert batch.parts is not None
    parts = {"true parts": batch.parts}
    for name, points in samples.items():
        result = task.step(batch, points)
        parts[name] = result.predictions
    return {"parts": part_grid(coordinates(batch.points), parts, titles)}
