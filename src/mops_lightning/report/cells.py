"""What stands in the cells of a table: figures by row, column, readout and seed."""

import statistics
from dataclasses import dataclass, field
from typing import Any

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.metric_info import metric_info
from mops_lightning.records.readout_names import FULL, GENERATED_READOUTS, INDEX_READOUT, parse
from mops_lightning.report.axes import Axes, row, value
from mops_lightning.report.collect import Record, learned, seed

Column = Any
"""A size, another setting's value, or a pair of values in a heat map."""


@dataclass
class Cells:
    """The figures of one metric.

    Attributes:
        metric: its name, unit and label.
        figures: row → column → readout → seed → value.
        own: rows and columns that come from runs of the sampler itself, not from a baseline that
            was tested beside another sampler.
    """

    metric: MetricInfo
    figures: dict[str, dict[Column, dict[str, dict[int, float]]]] = field(default_factory=dict)
    own: set[tuple[str, Column]] = field(default_factory=set)

    def columns(self) -> list[Column]:
        """Return all columns, the largest first."""
        return sorted({one for row in self.figures.values() for one in row}, reverse=True)

    def rows(self) -> list[str]:
        """Return all rows in the paper's order, other nets last."""
        return sorted(self.figures, key=place)

    def text(self, row: str, column: Column) -> str:
        """Return generated / matched / completed figures, or one; over seeds mean ± deviation."""
        cell = self.figures[row].get(column, {})
        names = [name for name in (INDEX_READOUT, *GENERATED_READOUTS) if name in cell]
        texts = [over_seeds(self.metric, list(cell[name].values())) for name in names]
        count = max((len(cell[name]) for name in names), default=0)
        return " / ".join(texts) + (f" (n={count})" if count > 1 else "")


def cells(found: list[Record], metric: str, net: str, axes: Axes) -> Cells:
    """Sort the records' figures into a table.

    Args:
        found: completed records.
        metric: the name behind the readout.
        net: the task net of the table; what others made of a sampler's points are other rows.
        axes: what the columns are.

    Raises:
        UserError: no record has the metric, or two runs of one seed would stand in one cell.
    """
    table = Cells(metric_info(metric, found))
    for record in found:
        _add(table, record, net, axes)
    if not table.figures:
        known = {parts.metric for r in found for parts in map(parse, r["metrics"]) if parts}
        raise UserError(f"--metric: no run has {metric!r}.{did_you_mean(metric, known)}")
    return table


def _add(table: Cells, record: Record, net: str, axes: Axes) -> None:
    mine = row(record, net)
    other = mine.removesuffix(record["config"]["names"]["sampler"])
    for name, figure in record["metrics"].items():
        parts = parse(name)
        if parts is None or parts.metric != table.metric.name or parts.readout == FULL:
            continue
        if figure is None:
            continue
        if axes != Axes() and parts.m not in (None, record["config"]["m"]):
            continue  # one size in a table of something else: the one that the run is about
        column: Column = value(record, axes.column)
        if axes.planes:
            column = tuple(value(record, key) for key in axes.planes[mine])
        elif axes.column == "m":
            column = parts.m or column
        if parts.readout in (INDEX_READOUT, *GENERATED_READOUTS):
            label, readout = mine, parts.readout
            if (label, column) not in table.own:
                table.figures.setdefault(label, {})[column] = {}
                table.own.add((label, column))
            values = table.figures[label][column].setdefault(readout, {})
            if seed(record) in values:
                raise UserError(
                    f"Two runs of {label} with {axes.column}={column} and seed={seed(record)} are "
                    f"there, the second one in {record['folder']}; give a folder with one of each."
                )
        else:
            # After joint training each run has a task net, and baselines under it, of its own.
            label, readout = other + parts.readout, INDEX_READOUT
            if axes.planes or (label, column) in table.own or learned(record) == "joint":
                continue
            there = table.figures.setdefault(label, {}).setdefault(column, {})
            values = there.setdefault(readout, {})
        values[seed(record)] = figure


def over_seeds(metric: MetricInfo, values: list[float]) -> str:
    """Return a value, or mean ± standard deviation of several, in the metric's unit."""
    mean = metric.format(statistics.fmean(values))
    if len(values) == 1:
        return mean
    # To the mean's last place: more would be noise.
    places = len(mean.partition(".")[2]) if "e" not in mean else 0
    deviation = metric.scale * statistics.stdev(values)
    return f"{mean} ± {deviation:.{max(places, 2)}f}"


ORDER = (
    "random",
    "voxel",
    "fps",
    "poisson",
    "snet",
    "snet_progressive",
    "samplenet",
    "samplenet_progressive",
    "mops",
    "fmops",
)
"""Samplers as in the paper's tables; others by name behind them."""


def place(row: str) -> tuple[int, str]:
    """Return a key that sorts rows as the paper's tables do."""
    name = row.rsplit(" ", 1)[-1]  # behind "icp on"
    number = ORDER.index(name) if name in ORDER else len(ORDER)
    return number + len(ORDER) * (name != row) * 2, row
