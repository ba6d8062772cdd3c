"""A user's own metric and task."""

from torchmetrics import MetricCollection

from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.tasks.classification import Classification


class Doubt(Accuracy):
    """Fraction of wrong answers, per mille."""

    name = "doubt"
    label = "wrong answers"
    unit = "‰"
    scale = 1000.0
    higher_is_better = False
    summary_order = 0

    def compute(self):
        return 1 - super().compute()


class DoubtfulClassification(Classification):
    score = Doubt.name

    def metrics(self, training: bool = False) -> MetricCollection:
        return collection(Doubt(self.num_classes), Accuracy(self.num_classes))
