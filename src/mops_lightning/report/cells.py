"""The values of one metric, sorted into a table's cells by row, column, readout and seed."""

import statistics
from dataclasses import dataclass, field
from typing import Any

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.metric_info import metric_info
from mops_lightning.records.readout_names import (
    FULL,
    GENERATED_READOUTS,
    INDEX_READOUT,
    REFINED,
    parse,
)
from mops_lightning.records.run_record import RunRecord
from mops_lightning.report.axes import Axes, row, value
from mops_lightning.report.collect import sampler_row, seed, trained_with

Column = Any
"""A size, a value of another setting, or a pair of values in a heat map."""


WITH_NET = f" {REFINED} (with the task net)"
"""End of the name of a row of refined samples."""


@dataclass
class Cells:
    """The values of one metric.

    Attributes:
        metric: its name, unit and label.
        values: row → column → readout → seed → value.
        own: rows and columns that come from runs of the sampler itself, not from a baseline that
            was tested in another sampler's run.
    """

    metric: MetricInfo
    values: dict[str, dict[Column, dict[str, dict[int, float]]]] = field(default_factory=dict)
    own: set[tuple[str, Column]] = field(default_factory=set)

    def columns(self) -> list[Column]:
        """Return all columns, the largest first."""
        return sorted({one for row in self.values.values() for one in row}, reverse=True)

    def rows(self) -> list[str]:
        """Return all rows in the paper's order, those of other nets last."""
        return sorted(self.values, key=sort_key)

    def text(self, row: str, column: Column) -> str:
        """Return the text of a cell.

        It is one value, or the generated / matched / completed ones; with several seeds mean ±
        standard deviation and their number.
        """
        cell = self.values[row].get(column, {})
        names = [name for name in (INDEX_READOUT, *GENERATED_READOUTS) if name in cell]
        texts = [over_seeds(self.metric, list(cell[name].values())) for name in names]
        count = max((len(cell[name]) for name in names), default=0)
        return " / ".join(texts) + (f" (n={count})" if count > 1 else "")

    def plane(self, row: str) -> dict[str, dict[Column, float]]:
        """Return readout → column → mean over seeds of one row."""
        found: dict[str, dict[Column, float]] = {}
        for column, readouts in self.values[row].items():
            for readout, by_seed in readouts.items():
                found.setdefault(readout, {})[column] = statistics.fmean(by_seed.values())
        return {name: found[name] for name in (*GENERATED_READOUTS, *found) if name in found}


def make_cells(found: list[RunRecord], metric: str, net: str, axes: Axes) -> Cells:
    """Sort the records' values into a table.

    Args:
        found: completed records.
        metric: name of the metric.
        net: the task net of the table; results under other nets get rows of their own.
        axes: the meaning of the columns.

    Raises:
        UserError: no record has the metric, or two runs of one seed belong in one cell.
    """
    table = Cells(metric_info(metric, found))
    for record in found:
        _add(table, record, net, axes)
    if not table.values:
        known = {parts.metric for r in found for parts in map(parse, r.metrics) if parts}
        raise UserError(f"--metric: no run has {metric!r}.{did_you_mean(metric, known)}")
    return table


def _add(table: Cells, record: RunRecord, net: str, axes: Axes) -> None:
    own_row = row(record, net)
    prefix = own_row.removesuffix(sampler_row(record))  # such as "icp on "
    for name, figure in record.metrics.items():
        parts = parse(name)
        if parts is None or parts.metric != table.metric.name or parts.readout == FULL:
            continue
        if figure is None:
            continue
        if axes != Axes() and parts.m not in (None, record.config["m"]):
            continue  # tables by another setting show the run's own size only
        column: Column = value(record, axes.column)
        if axes.planes:
            column = tuple(value(record, key) for key in axes.planes[own_row])
        elif axes.column == "m":
            column = parts.m or column
        if parts.readout in (INDEX_READOUT, *GENERATED_READOUTS, REFINED):
            refined = parts.readout == REFINED
            if axes.planes and refined:
                continue
            own, readout = own_row + WITH_NET * refined, parts.readout
            readout = INDEX_READOUT if refined else readout
            place = (own, column)
            if place not in table.own:  # replaces values of a baseline
                table.values.setdefault(own, {})[column] = {}
                table.own.add(place)
            values = table.values[own][column].setdefault(readout, {})
            if seed(record) in values:
                raise UserError(
                    f"Two runs of {own} have {axes.column}={column} and seed={seed(record)}; "
                    f"the second is {record.folder}. Give a folder with one of each."
                )
        else:
            place, readout = (prefix + parts.readout, column), INDEX_READOUT
            # Joint training gives each run its own task net, under which its baselines ran too.
            if axes.planes or place in table.own or trained_with(record) == "joint":
                continue
            cell = table.values.setdefault(place[0], {}).setdefault(column, {})
            values = cell.setdefault(readout, {})
        values[seed(record)] = figure


def over_seeds(metric: MetricInfo, values: list[float]) -> str:
    """Return a value, or mean ± standard deviation of several, in the metric's unit."""
    mean = metric.format(statistics.fmean(values))
    if len(values) == 1:
        return mean
    # As many decimals as the mean has, at least two.
    places = len(mean.partition(".")[2]) if "e" not in mean else 0
    deviation = metric.scale * statistics.stdev(values)
    return f"{mean} ± {deviation:.{max(places, 2)}f}"


ORDER = (
    "random",
    "voxel",
    "fps",
    "poisson",
    "critical",
    "submodular",
    "gumbel",
    "snet",
    "snet_progressive",
    "samplenet",
    "samplenet_progressive",
    "mops",
    "fmops",
)
"""Samplers in the order of the paper's tables; others follow by name."""


def sort_key(row: str) -> tuple[int, str]:
    """Return a key that sorts rows as the paper's tables do."""
    plain = row.removesuffix(WITH_NET)
    _, other_net, sampler = plain.rpartition(" on ")  # such as "icp on mops fast"
    name = sampler.split()[0]  # without its recipe
    number = ORDER.index(name) if name in ORDER else len(ORDER)
    return number + len(ORDER) * bool(other_net) * 2, row
