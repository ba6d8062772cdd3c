"""The long form of records, and tables of one metric from it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.metric_info import metric_info
from mops_lightning.records.readout_names import (
    COMPLETED,
    FULL,
    GENERATED,
    GENERATED_READOUTS,
    INDEX_READOUT,
    PROJECTED,
    parse_metric_name,
)
from mops_lightning.records.run_record import Names, RunRecord
from mops_lightning.records.summary import baseline_name
from mops_lightning.report.collect import epochs, sampler_row, seed, trained_with
from mops_lightning.report.comparable import Group, value

READOUTS = (INDEX_READOUT, *GENERATED_READOUTS, PROJECTED)
"""Readouts of a cell, in its order."""

ORDER = (
    *("random", "serial", "voxel", "fps", "poisson", "critical", "submodular", "gumbel", "snet"),
    *("samplenet", "samplenet_progressive", "mops", "fmops"),
)
"""Samplers in the order of the paper's tables; others follow by name."""


NOT_IN_CSV = ("row", "size", "started")
"""Further columns of the long form: the row of a value, the run's own size, and its start."""


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
        full: the long form of all metrics on full clouds, with ``column``.
        hidden: folders of runs that are not shown, because a later run has the same place.
    """

    metric: MetricInfo
    group: Group
    net: str
    values: pd.DataFrame
    full: pd.DataFrame
    hidden: list[str]

    @property
    def names(self) -> Names:
        """The names that the records share: of task and dataset."""
        return self.group.records[0].config["names"]

    @property
    def sizes(self) -> str:
        """The sizes of the runs."""
        return "/".join(map(str, sorted({one.config["m"] for one in self.group.records})))

    @property
    def full_metric(self) -> MetricInfo:
        """The metric of full clouds: errors that are normalized by theirs are 1 there."""
        name = self.metric.full_cloud_metric or self.metric.name
        return metric_info(name, self.group.records)

    def columns(self) -> list[Any]:
        """Return all columns: sizes from the largest, other values from the smallest."""
        return sorted(self.values["column"].unique(), reverse=self.group.column == "m")

    def rows(self) -> list[str]:
        """Return all rows in the paper's order, rows of other nets last."""
        return sorted(self.values["row"].unique(), key=sort_key)

    def readouts(self, row: str) -> list[str]:
        """Return the readouts of a row, in their order."""
        present = set(self.values.loc[self.values["row"] == row, "readout"])
        return [name for name in READOUTS if name in present]

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
        parts = (Part(over_seeds(self.metric, one.mean, one.std), one.rank) for one in found)
        return Cell(tuple(parts), f" (n={count})" if count > 1 else "")


def long_form(found: list[RunRecord], net: str, keys: Sequence[str] = ()) -> pd.DataFrame:
    """Return one row for every test value of every record: the columns of ``table.csv``, and more.

    Args:
        found: completed records.
        net: the table's task net.
        keys: settings that get a column, dotted.
    """
    rows = []
    for record, label in zip(found, net_labels(found), strict=True):
        facts = {
            "folder": record.folder,
            "sampler": row_name(record, net),
            "learn": trained_with(record),
            "seed": seed(record),
            "epochs": epochs(record) or 0,
            **{key: value(record, key) for key in keys},
            "net": label,
            "commit": record.git["commit"],
            "device": record.device,
            "size": record.config["m"],
            "started": record.started,
        }
        for name, figure in record.metrics.items():
            parts = parse_metric_name(name)
            if parts is not None and figure is not None:
                m = record.config["m"] if parts.m is None else parts.m
                tested = {"m": m, "readout": parts.readout, "metric": parts.metric}
                row = _row(record, parts.readout, net)
                rows.append({**facts, **tested, "value": figure, "row": row})
    first = ["folder", "sampler", "learn", "seed", "epochs", "m", "readout", "metric", "value"]
    columns = [*first, *keys, "net", "commit", "device", *NOT_IN_CSV]
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
    long = long_form(group.records, net, group.settings)
    long["down"], long["column"] = 0.0, 0.0 if group.planes else long[group.column].fillna("none")
    for name, pair in group.planes.items():
        own = long["sampler"] == name
        long.loc[own, ["down", "column"]] = long.loc[own, pair].to_numpy(float)
    values = long[(long["metric"] == metric) & (long["readout"] != FULL)].copy()
    if values.empty:
        known = set(long["metric"])
        raise UserError(f"--metric: no run has {metric!r}.{did_you_mean(metric, known)}")
    values["own"] = values["readout"].isin(READOUTS)
    if group.settings:  # the run's own size only
        values = values[values["m"] == values["size"]]
    if group.planes:
        values = values[values["own"]]
    # Joint training gives each run its own task net, under which its baselines ran too.
    values = values[values["own"] | (values["learn"] != "joint")]
    values["readout"] = values["readout"].where(values["readout"].isin(READOUTS), INDEX_READOUT)
    place = ["row", "m", "column", "down"]
    tested = values.groupby(place, dropna=False)["own"].transform("any")
    values = values[values["own"] | ~tested].sort_values("started", kind="stable")
    later = values["folder"] != values.groupby([*place, "seed"])["folder"].transform("last")
    hidden = sorted(set(values.loc[later & values["own"], "folder"]))
    over = values[~later].groupby([*place, "readout"], sort=False)["value"]
    table = over.agg(mean="mean", std="std", count_="count").reset_index()
    info = metric_info(metric, group.records)
    return Table(info, group, net, _ranked(table, info), long[long["readout"] == FULL], hidden)


def _ranked(table: pd.DataFrame, metric: MetricInfo) -> pd.DataFrame:
    """Add the rank of each value among the rows of its column, and whether it is level.

    Points chosen from the input compete with completed sets, projected points with generated
    ones. Equal texts have equal ranks. A value
    is level with the best, and has its rank, if it is less than two standard deviations away: the
    larger of the two deviations over seeds.
    """
    table["rank"], table["level"] = 0, False
    if metric.higher_is_better is None:
        return table
    rivals = table["readout"].replace({INDEX_READOUT: COMPLETED, PROJECTED: GENERATED})
    shown = pd.to_numeric(table["mean"].map(metric.format))
    places = [rivals, table["m"], table["column"], table["down"]]
    top = "max" if metric.higher_is_better else "min"
    best = shown.groupby(places).transform(top)
    deviation = metric.scale * table["std"].fillna(0.0)
    of_best = deviation.where(shown == best).groupby(places).transform("max")
    near = (shown - best).abs() < 2 * np.maximum(deviation, of_best)
    second = shown.where((shown != best) & ~near).groupby(places).transform(top)
    several = shown.groupby(places).transform("count") > 1
    table["level"] = several & near & (shown != best)
    table.loc[several & (shown == second), "rank"] = 2
    table.loc[several & ((shown == best) | near), "rank"] = 1
    return table


def _row(record: RunRecord, readout: str, net: str) -> str:
    """Return the row of a value: a sampler or a baseline of its run."""
    own = row_name(record, net)
    if readout in (*READOUTS, FULL):
        return own
    prefix = own.removesuffix(sampler_row(record))  # such as "dgcnn on "
    return prefix + baseline_name(record.config, readout)


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


def over_seeds(metric: MetricInfo, mean: float, std: float) -> str:
    """Return mean ± standard deviation in the metric's unit; of one value, ``std`` is NaN."""
    text = metric.format(mean)
    if pd.isna(std):
        return text
    # As many decimals as the mean has, at least two.
    places = len(text.partition(".")[2]) if "e" not in text else 0
    return f"{text} ± {metric.scale * std:.{max(places, 2)}f}"


def sort_key(row: str) -> tuple[int, str]:
    """Return a key that sorts rows as the paper's tables do."""
    _, other_net, sampler = row.rpartition(" on ")  # such as "dgcnn on mops fast"
    name = sampler.split()[0]  # without its recipe
    number = ORDER.index(name) if name in ORDER else len(ORDER)
    return number + len(ORDER) * bool(other_net) * 2, row
