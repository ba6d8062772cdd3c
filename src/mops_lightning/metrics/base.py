"""The base classes of this package's metrics."""

from typing import Any, ClassVar

from torch import Tensor
from torchmetrics import MeanMetric, Metric, MetricCollection

from mops_lightning.metrics.info import DEFAULT_ORDER


class TableMetric(Metric):
    """A torchmetrics metric that declares how it is named and shown in tables.

    Subclasses set ``name``, ``higher_is_better`` and whatever differs from the defaults below.
    Logs, records, the table that ends a run and reports read these attributes; see
    ``info.MetricInfo`` for their meaning.
    """

    name: ClassVar[str]
    label: ClassVar[str] = ""
    unit: ClassVar[str] = ""
    scale: ClassVar[float] = 1.0
    summary_order: ClassVar[int | None] = DEFAULT_ORDER
    full_cloud_metric: ClassVar[str | None] = None

    is_differentiable = False
    full_state_update = False


_Mean: Any = MeanMetric  # it types ``update`` and some attributes for itself only


class MeanOverClouds(TableMetric, _Mean):
    """Mean over clouds or pairs of one number each; ``update`` passes the numbers to ``add``."""

    def __init__(self, **extra: Any) -> None:
        super().__init__(nan_strategy="disable", **extra)

    def add(self, values: Tensor) -> None:
        """Add one number per cloud, ``(B,)``."""
        MeanMetric.update(self, values)


def collection(*metrics: TableMetric) -> MetricCollection:
    """Return metrics as a collection, each under its own name."""
    return MetricCollection({metric.name: metric for metric in metrics}, compute_groups=False)
