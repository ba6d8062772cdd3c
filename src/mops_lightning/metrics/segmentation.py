"""How well the points of all test clouds are assigned to parts, which are the classes here."""

from torchmetrics.classification import MulticlassJaccardIndex

from mops_lightning.metrics.base import TableMetric
from mops_lightning.metrics.classification import Accuracy


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
