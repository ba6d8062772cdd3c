"""How well the points of all test clouds are assigned to parts."""

from typing import Any

from torchmetrics.classification import MulticlassAccuracy, MulticlassJaccardIndex

from mops_lightning.metrics.base import TableMetric


class MeanIoU(TableMetric, MulticlassJaccardIndex):
    """Mean over parts of intersection over union, over the points of all clouds.

    Args:
        num_parts: number of parts.
    """

    name = "mean_iou"
    label = "mean IoU"
    unit = "%"
    scale = 100.0
    summary_order = 1

    def __init__(self, num_parts: int, **extra: Any) -> None:
        super().__init__(num_parts, **extra)


class PointAccuracy(TableMetric, MulticlassAccuracy):
    """Fraction of points that are assigned to their part.

    Args:
        num_parts: number of parts.
    """

    name = "point_accuracy"
    unit = "%"
    scale = 100.0
    summary_order = 2

    def __init__(self, num_parts: int, **extra: Any) -> None:
        super().__init__(num_parts, average="micro", **extra)
