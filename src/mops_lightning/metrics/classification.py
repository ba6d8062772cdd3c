"""Accuracy of predicted classes over all clouds of a test."""

from typing import Any, ClassVar, Literal

from torchmetrics.classification import MulticlassAccuracy

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
