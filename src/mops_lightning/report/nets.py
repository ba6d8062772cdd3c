"""A table of task nets: their results on full clouds, their sizes and costs."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd
from pandas.api.types import is_numeric_dtype

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.nets.by_run import BY_RUN
from mops_lightning.records.metric_info import in_summary_order, metric_info
from mops_lightning.records.readout_names import FULL
from mops_lightning.records.run_record import RunRecord
from mops_lightning.report import collect, comparable, paper
from mops_lightning.report.collect import score, seed, training_time
from mops_lightning.report.tables import DIRTY, dirty_line, over_seeds
from mops_lightning.report.text import PAPER, Grid
from mops_lightning.tree import dotted

BYTES = 4
"""Bytes of a parameter in float32."""

CLASS = "._target_"
"""End of the key of a class, which is shown by its name."""

NAMES = {"points": "points after stages"}
"""Settings of a net whose names have another meaning in the table."""


def nets_grid(group: comparable.Group, metrics: Sequence[str] = ()) -> Grid:
    """Return a table with a row for each net, sorted by number of points and settings.

    Sizes are of float32 parameters, in MB of a million bytes. Values of several seeds are means ±
    standard deviations; of two runs of a net and a seed with the same settings, the later one
    counts. The last column has the paper's values for the same net, if there are any.

    Args:
        group: completed records of runs with ``learn=task``.
        metrics: names of the metrics to show; none: the metrics of the closing table.

    Raises:
        UserError: no record has a metric.
    """
    found = sorted(group.records, key=lambda record: record.started)
    infos = _metrics(found, metrics)
    settings = _settings(found)
    keys = _distinguishing(settings)
    rows = _by_row(found, settings, keys)
    titles = [info.title for info in infos]
    cost, _ = training_time(found)
    head = ["net", *keys, "points", *titles, "MB", cost, PAPER]
    lines = [row.cells(infos) for row in rows]
    table = pd.DataFrame(lines, columns=head)
    # Not every table has costs and figures of the paper.
    for optional in head[-2:]:
        if not any(table[optional]):
            table = table.drop(columns=optional)
    names = collect.names(found[0])
    task = f"{names['task']} on {names['dataset']}"
    title = f"No sampler was tested; {task} from all points."
    if group.about:
        title += f" ({group.about})"
    is_dirty = any(record.git["dirty"] for record in found)
    cells = table.to_numpy().tolist()
    return Grid(title, list(table), cells, dirty_line(is_dirty))


@dataclass
class _Row:
    """A row of the table.

    Attributes:
        settings: of the net, in the order of the table's columns.
        records: of its runs, one for each seed, sorted by start.
    """

    settings: list[Any]
    records: list[RunRecord]

    def cells(self, metrics: list[MetricInfo]) -> list[str]:
        """Return the texts of the row, over all its seeds."""
        first = self.records[0]
        name = collect.names(first)["net"]
        texts = []
        for value in (name, *self.settings, _points(first)):
            text = ""
            if value is not None:
                text = str(value)
            texts.append(text)
        texts += [self._score(metric) for metric in metrics]
        texts.append(_megabytes(first))
        texts.append(_cost(self.records))
        texts.append(_paper(first))
        return texts

    def _score(self, metric: MetricInfo) -> str:
        """Return the cell of a metric; empty if no run has it."""
        key = f"test/{FULL}/{metric.name}"
        figures = [record.metrics.get(key) for record in self.records]
        values = pd.Series(figures)
        count = values.count()
        if not count:
            return ""
        text = over_seeds(metric, values.mean(), values.std())
        if count > 1:
            text += f" (n={count})"
        if any(record.git["dirty"] for record in self.records):
            text += f" {DIRTY}"
        return text


def _megabytes(record: RunRecord) -> str:
    """Return the size of a record's net in float32; empty if it is not known."""
    parameters = record.parameters.get("task")
    if parameters is None:
        return ""
    return f"{BYTES * parameters / 1e6:.1f}"


def _cost(records: list[RunRecord]) -> str:
    """Return the mean time of trainings; empty if none was recorded."""
    _, times = training_time(records)
    seconds = pd.Series(times, dtype=float).mean()
    if pd.isna(seconds):
        return ""
    return f"{seconds:,.0f} s"


def _distinguishing(settings: list[dict[str, Any]]) -> list[str]:
    """Return the settings that differ between nets, sorted; those of single runs are left out."""
    table = pd.DataFrame(settings)
    table = table.drop(columns=[*BY_RUN], errors="ignore")
    keys = []
    for key in sorted(table):
        values = table[key].dropna().map(str)
        if values.nunique() > 1:
            keys.append(key)
    return keys


def _by_row(found: list[RunRecord], settings: list[dict[str, Any]], keys: list[str]) -> list[_Row]:
    """Return the rows, sorted by number of points and settings.

    Args:
        found: the records, sorted by start.
        settings: of every record's net.
        keys: the settings that have columns.
    """
    runs = pd.DataFrame(settings)[keys].apply(_sortable)
    runs["points"] = [_points(record) for record in found]
    runs["net"] = [collect.names(record)["net"] for record in found]
    runs["seed"] = [seed(record) for record in found]
    runs["number"] = range(len(found))
    place = ["points", *keys, "net"]
    same = runs.groupby([*place, "seed"], sort=False, dropna=False)
    last = same.tail(1)
    in_order = last.sort_values(place, na_position="first")
    rows = []
    for _, of_net in in_order.groupby(place, sort=False, dropna=False):
        numbers = list(of_net["number"])
        of_first = settings[numbers[0]]
        values = [of_first.get(key) for key in keys]
        records = [found[number] for number in numbers]
        rows.append(_Row(values, records))
    return rows


def _sortable(values: pd.Series) -> pd.Series:
    """Return numbers as they are, and other values as texts."""
    if is_numeric_dtype(values):
        return values
    return values.map(str, na_action="ignore")


def _settings(found: list[RunRecord]) -> list[dict[str, Any]]:
    """Return the settings of every record's net, and of its training where these distinguish runs.

    Settings of the training differ between runs of one net and seed, and are set in every record.
    """
    nets = [_net(record) for record in found]
    trainings = _trainings(found, nets)
    for record, net in zip(found, nets, strict=True):
        for key in trainings:
            text = comparable.value(record, key)
            if key.endswith(CLASS):
                net[key.removesuffix(CLASS)] = text.rpartition(".")[2]
            else:
                net[key] = text
    return nets


def _trainings(found: list[RunRecord], nets: list[dict[str, Any]]) -> list[str]:
    """Return the settings of trainings in which runs of one net and seed differ, sorted."""
    same: dict[str, list[RunRecord]] = defaultdict(list)
    for record, net in zip(found, nets, strict=True):
        name = collect.names(record)["net"]
        place = repr([name, net, _points(record), seed(record)])
        same[place].append(record)
    different: set[str] = set()
    for runs in same.values():
        different.update(comparable.varying(runs))
    settings = [comparable.considered(record) for record in found]
    return sorted(key for key in different if _is_set_in_all(key, settings))


def _is_set_in_all(key: str, settings: list[dict[str, Any]]) -> bool:
    return all(of_run.get(key) is not None for of_run in settings)


def _net(record: RunRecord) -> dict[str, Any]:
    """Return the dotted settings of a net; of a sampler inside it, also the name of its module."""
    net: dict[str, Any] = {}
    for key, value in dotted(_arguments(record)).items():
        part, _, name = key.rpartition(".")
        if name == "_target_":
            if part:
                net[part] = _module(str(value))
            continue
        shown = NAMES.get(key, key)
        net[shown] = value
        if part and value is None:
            net[shown] = "none"
    return net


def _module(target: str) -> str:
    """Return the name of the module of a class, such as ``fps`` of ``….samplers.fps.FPS``."""
    path, _, name = target.rpartition(".")
    if not path:
        return name
    return path.rpartition(".")[2]


def _arguments(record: RunRecord) -> dict[str, Any]:
    return record.config["task"].get("net") or {}


def _points(record: RunRecord) -> int | None:
    return record.config["dataset"].get("n_points")


def _metrics(found: list[RunRecord], requested: Sequence[str]) -> list[MetricInfo]:
    """Return the metrics of full clouds: the requested ones, or all of the closing table."""
    prefix = f"test/{FULL}/"
    known = set()
    for record in found:
        for key in record.metrics:
            if key.startswith(prefix):
                known.add(key.rpartition("/")[2])
    for name in requested:
        if name not in known:
            hint = did_you_mean(name, known)
            raise UserError(f"--metric: no run has {name!r}.{hint}")
    if requested:
        return [metric_info(name, found) for name in requested]
    infos = in_summary_order([metric_info(name, found) for name in known])
    return [info for info in infos if info.full_cloud_metric is None]  # the rest is 1 here


def _paper(record: RunRecord) -> str:
    """Return the paper's figures for the same net; empty if it has none."""
    names = collect.names(record)
    if names["task"] == "reconstruction":
        pieces = _arguments(record).get("pieces")
        values = paper.net(names["net"], pieces, _points(record))
        if values:
            return " / ".join(f"{value:g}" for value in values)
    metric = score([record])
    table = paper.published(names["task"], names["net"], names["dataset"], metric)
    figure = table.get("full")
    if figure is None:
        return ""
    return f"{figure:.2f}"
