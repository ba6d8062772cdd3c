"""Names, units and order of metrics in tables; imports no torch, so that ``--help`` stays quick."""

from collections.abc import Mapping
from typing import Any, Self

import msgspec

DEFAULT_ORDER = 10
"""Place in the closing table of metrics that declare none: after all that declare one."""


class MetricInfo(msgspec.Struct, frozen=True, omit_defaults=True):
    """Name, format and order of a metric. Metric classes declare them; see ``of``.

    Attributes:
        name: the last part of its log key, such as ``accuracy``.
        label: its name in tables, without the unit; empty: made from ``name``.
        unit: such as ``%`` or ``°``; empty for none. Values with a unit are shown with two
            decimals, values without with four significant digits.
        scale: factor from the computed value to its unit: 100 for a fraction shown in percent.
        higher_is_better: direction; None if there is none.
        summary_order: position in the table that ends a run, lowest first, ties by name. None:
            in the record only.
        full_cloud_metric: name of the metric shown for full clouds instead, for errors that are
            normalized by the error of the full cloud and therefore 1 there.
    """

    name: str
    label: str = ""
    unit: str = ""
    scale: float = 1.0
    higher_is_better: bool | None = None
    summary_order: int | None = DEFAULT_ORDER
    full_cloud_metric: str | None = None

    @classmethod
    def of(cls, name: str, metric: object) -> Self:
        """Read a metric's class attributes. Any torchmetrics class will do; missing ones default.

        Args:
            name: the metric's key in its collection.
            metric: the metric or its class.
        """
        declared = [field for field in cls.__struct_fields__ if hasattr(metric, field)]
        values = {field: getattr(metric, field) for field in declared}
        return cls.from_dict(name, values)

    @classmethod
    def from_dict(cls, name: str, values: Mapping[str, Any]) -> Self:
        """Build from the content of a record; keys of other versions are ignored."""
        return msgspec.convert({**values, "name": name}, cls)

    def as_dict(self) -> dict[str, Any]:
        """Return what differs from the defaults, without the name, as plain data."""
        plain = msgspec.to_builtins(self)
        del plain["name"]
        return plain

    @property
    def title(self) -> str:
        """The label with the unit in brackets."""
        label = self.label or self.name.replace("_", " ")
        if not self.unit:
            return label
        return f"{label} ({self.unit})"

    def format(self, value: float) -> str:
        """Return a value in the metric's unit, without the unit."""
        value *= self.scale
        if self.unit:
            return f"{value:.2f}"
        return f"{value:.4g}"
