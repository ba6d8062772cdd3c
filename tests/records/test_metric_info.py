import pytest
from torchmetrics.aggregation import SumMetric

from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.records.metric_info import foreign_metrics, in_summary_order, metric_info
from tests.support.records import record


@pytest.mark.parametrize(
    ("name", "value", "title", "text"),
    [
        ("accuracy", 0.81234, "accuracy (%)", "81.23"),
        ("rotation_error_deg", 7.2149, "rotation error (°)", "7.21"),
        ("nonzero_percent", 2.5, "non-zero entries of S (%)", "2.50"),
        ("unheard_of", 0.5, "unheard of", "0.5"),
    ],
)
def test_metric_info_without_records_reads_classes(name, value, title, text):
    info = metric_info(name)
    assert info.title == title
    assert info.format(value) == text


class Spread(Accuracy):
    name = "spread"
    label = "spread of points"
    unit = "mm"
    scale = 1000.0
    higher_is_better = False
    summary_order = 2


def test_foreign_metric_is_read_back_from_record():
    foreign = foreign_metrics(collection(Spread(3), Accuracy(3)).items())
    assert list(foreign) == ["spread"]
    info = metric_info("spread", [record(), record(metric_info=foreign)])
    assert info.title == "spread of points (mm)"
    assert info.format(0.5) == "500.00"
    assert info.higher_is_better is False


def test_plain_torchmetrics_class_gets_defaults():
    """Even under the name of a metric of this package."""
    foreign = foreign_metrics([("accuracy", SumMetric())])
    info = metric_info("accuracy", [record(metric_info=foreign)])
    assert (info.title, info.format(0.5), info.summary_order) == ("accuracy", "0.5", 10)


def test_summary_order_sorts_and_drops_hidden():
    names = ["translation_error", "b", "unique_points", "a", "rotation_error_deg"]
    shown = in_summary_order(map(metric_info, names))
    assert [info.name for info in shown] == ["rotation_error_deg", "translation_error", "a", "b"]
