"""Label, unit and order of the metrics in records."""

from collections.abc import Iterable
from functools import cache
from typing import Any

from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.run_record import RunRecord

PACKAGE = "mops_lightning."
"""Where the metrics are whose classes a report knows."""


def foreign_metrics(
    metrics: Iterable[tuple[str, object]],
) -> dict[str, dict[str, Any]]:
    """Return label, unit and direction of the metrics that this package does not know.

    Args:
        metrics: names and metrics, such as the items of a collection.

    Returns:
        Name of the metric → what its class declares, as plain data for a record.
    """
    described = {}
    for name, metric in metrics:
        is_of_package = type(metric).__module__.startswith(PACKAGE)
        is_known = is_of_package and getattr(metric, "name", "") == name
        if not is_known:
            info = MetricInfo.of(name, metric)
            described[name] = info.as_dict()
    return described


def metric_info(name: str, records: Iterable[RunRecord] = ()) -> MetricInfo:
    """Return label, unit and order of a metric.

    Args:
        name: the last part of its log key.
        records: run records; the first that describes the metric is used. Otherwise its class in
            this package; a name that is unknown there too has no unit.
    """
    for record in records:
        values = record.metric_info.get(name)
        if values is not None:
            return MetricInfo.from_dict(name, values)
    unknown = MetricInfo(name)
    return _package_metrics().get(name, unknown)


def in_summary_order(infos: Iterable[MetricInfo]) -> list[MetricInfo]:
    """Return the metrics of the table that ends a run, in its order."""
    shown = [info for info in infos if info.summary_order is not None]
    return sorted(shown, key=_summary_key)


def _summary_key(info: MetricInfo) -> tuple[int, str]:
    return info.summary_order or 0, info.name


@cache
def _package_metrics() -> dict[str, MetricInfo]:
    # Imported here because they need torch.
    from mops_lightning.metrics import classification, reconstruction, registration, sampled_set
    from mops_lightning.metrics.base import TableMetric

    infos = {}
    for module in (classification, reconstruction, registration, sampled_set):
        for value in vars(module).values():
            is_metric = isinstance(value, type) and issubclass(value, TableMetric)
            if is_metric and hasattr(value, "name"):
                infos[value.name] = MetricInfo.of(value.name, value)
    return infos
