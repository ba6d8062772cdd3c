"""How well all clouds of a test are assigned to classes, or their points to parts."""

from typing import Any, ClassVar, Literal

from torchmetrics.classification import MulticlassAccuracy, MulticlassJaccardIndex

from mops_lightning.metrics.base import TableMetric


class Accuracy(TableMetric, MulticlassAccuracy):
    """Fraction of clouds that are assigned to their class.

    Args:
        num_classes: number of classes.
    """

    name = "accuracy"
    unit = "%"
    scale = 100.0
    summary_order: ClassVar[int | None] = 1
    averaging: ClassVar[Literal["micro", "macro"]] = "micro"

    def __init__(self, num_classes: int, **extra: Any) -> None:
        # Checking the labels in every step would wait for a GPU; the data sets have checked them.
        super().__init__(num_classes, average=self.averaging, validate_args=False, **extra)


class MeanClassAccuracy(Accuracy):
    """Mean over classes of the fraction of their clouds that are assigned to them.

    Args:
        num_classes: number of classes.
    """

    name = "mean_class_accuracy"
    summary_order = 2
    averaging = "macro"


class MeanIoU(TableMetric, MulticlassJaccardIndex):
    """Mean over parts of intersection over union, over the points of all clouds."""

    name = "mean_iou"
    label = "mean IoU"
    unit = "%"
    scale = 100.0
    summary_order = 1


class PointAccuracy(Accuracy):
    """Fraction of points that are assigned to their part."""

    name = "point_accuracy"
    summary_order = 2
