import json

import pytest

from mops_lightning.metrics.info import DEFAULT_ORDER, MetricInfo


@pytest.mark.parametrize(
    ("info", "title", "text"),
    [
        (MetricInfo("a_b"), "a b", "0.01235"),
        (MetricInfo("a_b", label="wrong"), "wrong", "0.01235"),
        (MetricInfo("a_b", unit="°"), "a b (°)", "0.01"),
        (MetricInfo("a", unit="%", scale=100.0), "a (%)", "1.23"),
    ],
)
def test_info_unit_sets_title_and_decimals(info, title, text):
    assert info.title == title
    assert info.format(0.012345678) == text


def test_info_of_class_reads_known_attributes():
    class Metric:
        unit = "mm"
        higher_is_better = False
        summary_order = None
        other = 1

    info = MetricInfo.of("length", Metric)
    assert info == MetricInfo("length", unit="mm", higher_is_better=False, summary_order=None)
    assert MetricInfo.of("length", object()) == MetricInfo("length", summary_order=DEFAULT_ORDER)


def test_info_survives_json():
    info = MetricInfo("a", "b", "c", 2.0, True, None, "d")
    assert MetricInfo.from_dict("a", json.loads(json.dumps(info.as_dict()))) == info
    assert MetricInfo("a").as_dict() == {}
