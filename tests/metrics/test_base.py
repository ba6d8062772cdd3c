import pytest

from mops_lightning.metrics import classification, reconstruction, registration, sampled_set
from mops_lightning.metrics.base import TableMetric

METRICS = [
    value
    for module in (classification, reconstruction, registration, sampled_set)
    for value in vars(module).values()
    if isinstance(value, type) and issubclass(value, TableMetric) and hasattr(value, "name")
]


@pytest.mark.parametrize("metric", METRICS)
def test_metric_declares_direction_and_documents_itself(metric):
    assert isinstance(metric.higher_is_better, bool)
    assert "__doc__" in vars(metric)


def test_metric_names_are_unique():
    names = [metric.name for metric in METRICS]
    assert len(set(names)) == len(names) > 0
