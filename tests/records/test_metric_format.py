import pytest

from mops_lightning.records.metric_format import figure, title


@pytest.mark.parametrize(
    ("metric", "value", "name", "shown"),
    [
        ("accuracy", 0.81234, "accuracy (%)", "81.23"),
        ("mean_class_accuracy", 1.0, "mean class accuracy (%)", "100.00"),
        ("rotation_error_deg", 7.2149, "rotation error (°)", "7.21"),
        ("rotation_error_p90_deg", 120.0, "rotation error p90 (°)", "120.00"),
        ("rotation_recall_5deg", 0.5, "rotation recall 5deg (%)", "50.00"),
        ("translation_error", 0.0123456, "translation error", "0.01235"),
    ],
)
def test_metrics_are_shown_in_their_units(metric, value, name, shown):
    assert title(metric) == name
    assert figure(metric, value) == shown
