from torchmetrics.aggregation import SumMetric

from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.records.metric_info import foreign_metrics, metric_info
from tests.support.records import record


def test_plain_torchmetrics_class_gets_defaults():
    """Even under the name of a metric of this package."""
    assert foreign_metrics(collection(Accuracy(3)).items()) == {}
    foreign = foreign_metrics([("accuracy", SumMetric())])
    info = metric_info("accuracy", [record(metric_info=foreign)])
    assert (info.title, info.format(0.5), info.summary_order) == ("accuracy", "0.5", 10)
