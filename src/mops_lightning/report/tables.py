"""The long form of records, and tables of one metric from it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.metric_info import metric_info
from mops_lightning.records.readout_names import (
    FULL,
    GENERATED_READOUTS,
    INDEX_READOUT,
    REFINED,
    parse_metric_name,
)
from mops_lightning.records.run_record import RunRecord
from mops_lightning.records.summary import baseline_name
from mops_lightning.report.collect import epochs, sampler_row, seed, trained_with
from mops_lightning.report.comparable import Group, value

WITH_NET = f" {REFINED} (with the task net)"
"""End of the name of a row of refined samples."""

READOUTS = (INDEX_READOUT, *GENERATED_READOUTS)
"""Readouts of a cell, in its order."""

ORDER = (
    *("random", "voxel", "fps", "poisson", "critical", "submodular", "gumbel", "snet"),
    *("snet_progressive", "samplenet", "samplenet_progressive", "mops", "fmops"),
)
"""Samplers in the order of the paper's tables; others follow by name."""


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
        return " / ".join(part.text for part in self.parts) + self.suffix


@dataclass
class Table:
    """The values of one metric.

    Attributes:
        metric: its name, unit and label.
        group: the records.
        net: the task net of the table; other nets are named in rows.
        values: one row for every cell and readout: ``row``, ``m``, ``column``, and for heat maps
            ``down``; ``readout``, ``mean`` and ``std`` over seeds, and their ``count``.
        hidden: folders of runs that are not shown, because a later run has the same place.
    """

    metric: MetricInfo
    group: Group
    net: str
    values: pd.DataFrame
    hidden: list[str] = field(default_factory=list)

    def columns(self) -> list[Any]:
        """Return all columns: sizes from the largest, other values from the smallest."""
        return sorted(self.values["column"].unique(), reverse=self.group.layout.column == "m")

    def rows(self) -> list[str]:
        """Return all rows in the paper's order, rows of other nets last."""
        return sorted(self.values["row"].unique(), key=sort_key)

    def readouts(self, row: str) -> list[str]:
        """Return the readouts of a row, in their order."""
        present = set(self.values.loc[self.values["row"] == row, "readout"])
        return [name for name in (*GENERATED_READOUTS, INDEX_READOUT) if name in present]

    def of(self, row: str, readout: str) -> pd.DataFrame:
        """Return the values of a row and a readout."""
        return self.values[(self.values["row"] == row) & (self.values["readout"] == readout)]

    def cells(self, index: Sequence[str]) -> pd.DataFrame:
        """Return the cells by columns of ``values`` and by ``column``; empty texts for none."""
        keys = [*index, "column"]
        cells = self.values.groupby(keys, sort=False)[list(self.values)].apply(self._cell)
        return cells.unstack("column", fill_value="")

    def _cell(self, values: pd.DataFrame) -> Cell:
        by_readout = {one.readout: one for one in values.itertuples()}
        found: list[Any] = [by_readout[name] for name in READOUTS if name in by_readout]
        count = max(int(one.count_) for one in found)
        parts = (Part(self._text(one.mean, one.std, one.count_), one.rank) for one in found)
        return Cell(tuple(parts), f" (n={count})" if count > 1 else "")

    def _text(self, mean: float, std: float, count: int) -> str:
        return over_seeds(self.metric, mean, std if count > 1 else None)


def long_form(found: list[RunRecord], net: str, keys: Sequence[str] = ()) -> pd.DataFrame:
    """Return one row for every test value of every record.

    Args:
        found: completed records.
        net: the table's task net.
        keys: settings that get a column, dotted.
    """
    rows = []
    labels = net_labels(found)
    for number, record in enumerate(found):
        facts = {
            "run": number,
            "folder": record.folder,
            "sampler": row_name(record, net),
            "learn": trained_with(record),
            "seed": seed(record),
            "epochs": epochs(record) or 0,
            **{key: value(record, key) for key in keys},
            "net": labels[number],
            "commit": record.git["commit"],
            "device": record.device,
        }
        for name, figure in record.metrics.items():
            parts = parse_metric_name(name)
            if parts is not None and figure is not None:
                tested = {"m": parts.m or record.config["m"], "readout": parts.readout}
                rows.append({**facts, **tested, "metric": parts.metric, "value": figure})
    facts_first = ["run", "folder", "sampler", "learn", "seed", "epochs"]
    tested_next = ["m", "readout", "metric", "value"]
    columns = [*facts_first, *tested_next, *keys, "net", "commit", "device"]
    return pd.DataFrame(rows, columns=columns)


def make_table(group: Group, metric: str, net: str) -> Table:
    """Sort the values of one metric into a table.

    Args:
        group: the records.
        metric: name of the metric.
        net: the task net of the table; results under other nets get separate rows.

    Raises:
        UserError: no record has the metric.
    """
    records, layout = group.records, group.layout
    long = long_form(records, net)
    values = long[(long["metric"] == metric) & (long["readout"] != FULL)].copy()
    if values.empty:
        known = set(long["metric"])
        raise UserError(f"--metric: no run has {metric!r}.{did_you_mean(metric, known)}")
    values["own"] = values["readout"].isin([*READOUTS, REFINED])
    values["row"] = [_row(records[one.run], one, net) for one in values.itertuples()]
    _add_columns(values, group)
    if layout.column not in ("m", "net"):  # the run's own size only
        sizes = values["run"].map(lambda run: records[run].config["m"])
        values = values[values["m"] == sizes]
    if layout.planes:
        values = values[values["own"] & (values["readout"] != REFINED)]
    # Joint training gives each run its own task net, under which its baselines ran too.
    values = values[values["own"] | (values["learn"] != "joint")]
    values["readout"] = values["readout"].where(values["readout"].isin(READOUTS), INDEX_READOUT)
    place = ["row", "m", "column", "down"]
    tested = values.groupby(place, dropna=False)["own"].transform("any")
    values = values[values["own"] | ~tested]
    started = values["run"].map(lambda run: records[run].started)
    values = values.assign(started=started).sort_values("started", kind="stable")
    later = values["run"] != values.groupby([*place, "seed"])["run"].transform("last")
    hidden = sorted(set(values.loc[later & values["own"], "folder"]))
    over = values[~later].groupby([*place, "readout"], sort=False)["value"]
    table = over.agg(mean="mean", std="std", count_="count").reset_index()
    return Table(metric_info(metric, records), group, net, _ranked(table, metric, records), hidden)


def _add_columns(values: pd.DataFrame, group: Group) -> None:
    """Add the columns that give the places of a table."""
    records, layout = group.records, group.layout
    values["down"] = 0.0
    if layout.column in ("m", "net"):
        values["column"] = values[layout.column]
        return
    if not layout.planes:
        values["column"] = values["run"].map(lambda run: value(records[run], layout.column))
        return
    keys = values["run"].map(lambda run: layout.planes[sampler_row(records[run])])
    for name, position in (("down", 0), ("column", 1)):
        pairs = zip(values["run"], keys, strict=True)
        values[name] = [value(records[run], pair[position]) for run, pair in pairs]


def _ranked(table: pd.DataFrame, name: str, records: list[RunRecord]) -> pd.DataFrame:
    """Add the rank of each value among the rows of its column.

    Points chosen from the input compete with completed sets. Equal texts have equal ranks.
    """
    metric = metric_info(name, records)
    table["rank"] = 0
    if metric.higher_is_better is None:
        return table
    rivals = table["readout"].replace(INDEX_READOUT, GENERATED_READOUTS[-1])
    shown = pd.to_numeric(table["mean"].map(metric.format))
    shown = shown.where(~table["row"].str.endswith(WITH_NET))
    places = shown.groupby([rivals, table["m"], table["column"], table["down"]])
    ranks = places.rank("dense", ascending=not metric.higher_is_better)
    several = places.transform("count") > 1
    table["rank"] = ranks.where(several & (ranks <= 2), 0).fillna(0).astype(int)
    return table


def _row(record: RunRecord, one: Any, net: str) -> str:
    """Return the row of a value: a sampler, a baseline of its run, or refined samples."""
    if one.readout == REFINED:
        return f"{one.sampler}{WITH_NET}"
    if one.readout in READOUTS:
        return one.sampler
    prefix = row_name(record, net).removesuffix(sampler_row(record))  # such as "icp on "
    return prefix + baseline_name(record.config, one.readout)


def row_name(record: RunRecord, net: str) -> str:
    """Return the row of a record's own results; it names a net that is not the table's."""
    own, sampler = record.config["names"]["net"], sampler_row(record)
    return sampler if net in ("", own) else f"{own} on {sampler}"


def net_labels(found: list[RunRecord]) -> list[str]:
    """Return a name for the task net of each record, other names for other weights."""
    labels: list[str] = []
    digests: dict[str, set[str | None]] = {}
    for record in found:
        name, given = record.config["names"]["net"], record.config.get("weights")
        if record.evaluated and given == "run":
            name += " of the training"
        elif given not in (None, "auto", "run"):
            file = Path(str(given).partition("@")[0]).name
            name = file if file.startswith(name) else f"{name} ({file})"
        labels.append(name)
        digests.setdefault(name, set()).add(record.task_weights_sha256)
    return [
        f"{label} {str(record.task_weights_sha256)[:8]}" if len(digests[label]) > 1 else label
        for label, record in zip(labels, found, strict=True)
    ]


def over_seeds(metric: MetricInfo, mean: float, std: float | None = None) -> str:
    """Return a value, or mean ± standard deviation of several, in the metric's unit."""
    text = metric.format(mean)
    if std is None:
        return text
    # As many decimals as the mean has, at least two.
    places = len(text.partition(".")[2]) if "e" not in text else 0
    return f"{text} ± {metric.scale * std:.{max(places, 2)}f}"


def sort_key(row: str) -> tuple[int, str]:
    """Return a key that sorts rows as the paper's tables do."""
    plain = row.removesuffix(WITH_NET)
    _, other_net, sampler = plain.rpartition(" on ")  # such as "icp on mops fast"
    name = sampler.split()[0]  # without its recipe
    number = ORDER.index(name) if name in ORDER else len(ORDER)
    return number + len(ORDER) * bool(other_net) * 2, row
