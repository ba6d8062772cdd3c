"""Label, unit and order of the metrics in records."""

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from mops_lightning.metrics.info import MetricInfo

NOTE = "metrics"
"""Key of a record's notes under which a run describes its metrics."""


def described(metrics: Iterable[tuple[str, object]]) -> dict[str, dict[str, Any]]:
    """Return what the classes of named metrics declare, as plain data for a record's notes."""
    return {name: MetricInfo.of(name, metric).as_dict() for name, metric in metrics}


def metric_info(name: str, records: Iterable[Mapping[str, Any]] = ()) -> MetricInfo:
    """Return what is known about a metric.

    Args:
        name: the last part of its log key.
        records: run records; the first that describes the metric is used. Otherwise the class of
            this package, as for records from before runs described their metrics; a name that is
            unknown there too has no unit.
    """
    for record in records:
        values = record["notes"].get(NOTE, {}).get(name)
        if values is not None:
            return MetricInfo.from_dict(name, values)
    return _package_metrics().get(name, MetricInfo(name))


def in_summary_order(infos: Iterable[MetricInfo]) -> list[MetricInfo]:
    """Return the metrics of the table that ends a run, in its order."""
    shown = [info for info in infos if info.summary_order is not None]
    return sorted(shown, key=lambda info: (info.summary_order or 0, info.name))


@cache
def _package_metrics() -> dict[str, MetricInfo]:
    # Imported here because they need torch.
    from mops_lightning.metrics import classification, reconstruction, registration, sampled_set
    from mops_lightning.metrics.base import TableMetric

    return {
        value.name: MetricInfo.of(value.name, value)
        for module in (classification, reconstruction, registration, sampled_set)
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, TableMetric) and hasattr(value, "name")
    }
