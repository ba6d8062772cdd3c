"""Tables of one metric."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import pandas as pd

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.metric_info import metric_info
from mops_lightning.records.readout_names import FULL, INDEX_READOUT
from mops_lightning.records.run_record import Names
from mops_lightning.records.summary import shown_names
from mops_lightning.report.collect import sampler_row
from mops_lightning.report.comparable import Group
from mops_lightning.report.long_form import long_form
from mops_lightning.report.ranks import ranked
from mops_lightning.report.rows import READOUTS, RowNames, sort_key

PLACE = ["row", "m", "column", "down"]
"""The columns of values that say which cell a value is in."""

DIRTY = "†"
"""Mark of a cell with a run whose checkout had changes."""


class Part(NamedTuple):
    """A value in a cell.

    Attributes:
        text: the value.
        rank: 1 for the best of its column and readout, 2 for the second, 0 for any other.
    """

    text: str
    rank: int = 0


class Cell(NamedTuple):
    """The values of a cell, one for each readout.

    Attributes:
        parts: the values, or one for samplers that choose input points.
        suffix: text behind them.
    """

    parts: tuple[Part, ...] = ()
    suffix: str = ""

    def __str__(self) -> str:
        texts = [part.text for part in self.parts]
        return " / ".join(texts) + self.suffix


@dataclass
class Table:
    """The values of one metric.

    Attributes:
        metric: its name, unit and label.
        group: the records.
        net: the task net of the table; other nets are named in rows.
        row_names: the rows of the records.
        values: one row for every cell and readout: ``row``, ``m``, ``column``, and for heat maps
            ``down``; ``readout``, ``mean`` and ``std`` over seeds, their ``count_``, ``rank``,
            ``level``, and ``dirty``: whether a checkout had changes.
        full: the long form of all metrics on full clouds, with ``column``.
        hidden: folders of runs that are not shown, because a later run has the same place.
    """

    metric: MetricInfo
    group: Group
    net: str
    row_names: RowNames
    values: pd.DataFrame
    full: pd.DataFrame
    hidden: list[str]

    @property
    def names(self) -> Names:
        """The names that the records share: of task and dataset."""
        return shown_names(self.group.records[0].config)

    @property
    def subject(self) -> str:
        """The task and the data, for titles."""
        names = self.names
        return f"{names['task']} on {names['dataset']}"

    @property
    def sizes(self) -> str:
        """The sizes of the runs."""
        sizes = {record.config["m"] for record in self.group.records}
        return "/".join(str(m) for m in sorted(sizes))

    @property
    def planes(self) -> dict[str, list[str]]:
        """Row → the two settings of its heat map; empty for tables by column."""
        return _planes(self.group, self.row_names)

    @property
    def full_metric(self) -> MetricInfo:
        """The metric of full clouds: errors that are normalized by theirs are 1 there."""
        name = self.metric.full_cloud_metric or self.metric.name
        return metric_info(name, self.group.records)

    def columns(self) -> list[Any]:
        """Return all columns: sizes from the largest, other values from the smallest."""
        is_by_size = self.group.column == "m"
        return sorted(self.values["column"].unique(), reverse=is_by_size)

    def rows(self) -> list[str]:
        """Return all rows in the paper's order, rows of other nets last."""
        return sorted(self.values["row"].unique(), key=sort_key)

    def readouts(self, row: str) -> list[str]:
        """Return the readouts of a row, in their order."""
        is_of_row = self.values["row"] == row
        present = set(self.values.loc[is_of_row, "readout"])
        return [name for name in READOUTS if name in present]

    def of(self, row: str, readout: str) -> pd.DataFrame:
        """Return the values of a row and a readout."""
        of_row = self.values[self.values["row"] == row]
        return of_row[of_row["readout"] == readout]

    def cells(self, index: Sequence[str]) -> pd.DataFrame:
        """Return the cells by columns of ``values`` and by ``column``; empty texts for none."""
        keys = [*index, "column"]
        groups = self.values.groupby(keys, sort=False)[list(self.values)]
        cells = groups.apply(self._cell)
        return cells.unstack("column", fill_value="")

    def _cell(self, values: pd.DataFrame) -> Cell:
        by_readout: dict[str, Any] = {}
        for value in values.itertuples():
            by_readout[value.readout] = value
        parts = []
        for name in READOUTS:
            if name in by_readout:
                value = by_readout[name]
                text = over_seeds(self.metric, value.mean, value.std)
                parts.append(Part(text, value.rank))
        seeds = int(values["count_"].max())
        suffix = ""
        if seeds > 1:
            suffix += f" (n={seeds})"
        if values["dirty"].any():
            suffix += f" {DIRTY}"
        return Cell(tuple(parts), suffix)


def make_table(group: Group, metric: str, net: str) -> Table:
    """Sort the values of one metric into a table.

    Args:
        group: the records.
        metric: name of the metric.
        net: the task net of the table; results under other nets get separate rows.

    Raises:
        UserError: no record has the metric.
    """
    rows = RowNames(group.records, net, group.settings)
    long = long_form(group.records, rows, group.settings)
    placed = _placed(long, group, rows)
    values = _tested(placed, metric, group)
    is_replaced = _replaced_later(values)
    cells = _over_seeds(values[~is_replaced])
    info = metric_info(metric, group.records)
    hidden = values.loc[is_replaced & values["own"], "folder"]
    return Table(
        metric=info,
        group=group,
        net=net,
        row_names=rows,
        values=ranked(cells, info),
        full=placed[placed["readout"] == FULL],
        hidden=sorted(set(hidden)),
    )


def _planes(group: Group, rows: RowNames) -> dict[str, list[str]]:
    """Return the two settings of every row's heat map."""
    planes: dict[str, list[str]] = {}
    if group.planes:
        for record in group.records:
            sampler = sampler_row(record)
            planes[rows.of(record)] = group.planes[sampler]
    return planes


def _placed(long: pd.DataFrame, group: Group, rows: RowNames) -> pd.DataFrame:
    """Add the place of every value in the layout of the group's table: ``column`` and ``down``."""
    long["down"] = 0.0
    if not group.planes:
        long["column"] = long[group.column].fillna("none")
        return long
    long["column"] = 0.0
    for name, (down, across) in _planes(group, rows).items():
        in_row = long["sampler"] == name
        of_row = long.loc[in_row]
        long.loc[in_row, "down"] = of_row[down].to_numpy(float)
        long.loc[in_row, "column"] = of_row[across].to_numpy(float)
    return long


def _tested(long: pd.DataFrame, metric: str, group: Group) -> pd.DataFrame:
    """Return the values of a metric that the table shows, the earlier run first.

    ``own`` says whether a value is of the run's own sampler, not of a baseline. A baseline counts
    where no run tested the same sampler.

    Raises:
        UserError: there is none.
    """
    is_tested = long["metric"] == metric
    is_sampled = long["readout"] != FULL
    values = long[is_tested & is_sampled].copy()
    if values.empty:
        hint = did_you_mean(metric, set(long["metric"]))
        raise UserError(f"--metric: no run has {metric!r}.{hint}")
    values["own"] = values["readout"].isin(READOUTS)
    if group.settings:
        at_own_size = values["m"] == values["size"]
        values = values[at_own_size]
    if group.planes:
        values = values[values["own"]]
    # Joint training gives each run its own task net, under which its baselines ran too.
    is_shared = values["learn"] != "joint"
    values = values[values["own"] | is_shared]
    values["readout"] = values["readout"].where(values["own"], INDEX_READOUT)
    places = values.groupby(PLACE, dropna=False)
    has_own_run = places["own"].transform("any")
    values = values[values["own"] | ~has_own_run]
    return values.sort_values("started", kind="stable")


def _replaced_later(values: pd.DataFrame) -> pd.Series:
    """Return which values a later run replaces: one with the same place and seed."""
    runs = values.groupby([*PLACE, "seed"])
    latest = runs["folder"].transform("last")
    return values["folder"] != latest


def _over_seeds(values: pd.DataFrame) -> pd.DataFrame:
    """Return a row for every cell and readout: mean, deviation and number over seeds."""
    cells = values.groupby([*PLACE, "readout"], sort=False)
    table = cells["value"].agg(mean="mean", std="std", count_="count")
    table["dirty"] = cells["dirty"].any()
    return table.reset_index()


def over_seeds(metric: MetricInfo, mean: float, std: float) -> str:
    """Return mean ± standard deviation in the metric's unit; of one value, ``std`` is NaN."""
    text = metric.format(mean)
    if pd.isna(std):
        return text
    # As many decimals as the mean has, at least two.
    decimals = ""
    if "e" not in text:
        decimals = text.partition(".")[2]
    places = max(len(decimals), 2)
    deviation = metric.scale * std
    return f"{text} ± {deviation:.{places}f}"


def dirty_line(is_dirty: bool) -> list[str]:
    """Return a line that says what the mark of a changed checkout means, if a cell has it."""
    if not is_dirty:
        return []
    return [f"{DIRTY} With a run whose checkout had changes that no commit has."]
