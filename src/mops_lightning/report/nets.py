"""A table of task nets: their results on full clouds, their sizes and costs."""

from collections.abc import Iterable, Sequence
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
    names = collect.names(found[0])
    infos = _metrics(found, metrics)
    shown = _settings(found)
    settings = pd.DataFrame(shown).drop(columns=[*BY_RUN], errors="ignore")
    keys = [key for key in sorted(settings) if settings[key].dropna().map(str).nunique() > 1]
    runs = settings[keys].apply(_sortable).assign(points=[_points(one) for one in found])
    runs = runs.assign(net=[collect.names(one)["net"] for one in found])
    runs = runs.assign(record=found, settings=shown)
    place = ["points", *keys, "net"]
    runs["seed"] = [seed(one) for one in found]
    last = runs.groupby([*place, "seed"], sort=False, dropna=False).tail(1)
    nets = last.sort_values(place, na_position="first").groupby(place, sort=False, dropna=False)
    lines = [
        _row([*of_net["record"]], map(of_net["settings"].iloc[0].get, keys), infos)
        for _, of_net in nets
    ]
    titles = (info.title for info in infos)
    head = ["net", *keys, "points", *titles, "MB", training_time(found)[0], PAPER]
    table = pd.DataFrame(lines, columns=head)
    # Not every table has costs and figures of the paper.
    table = table.drop(columns=[name for name in head[-2:] if not any(table[name])])
    title = f"No sampler was tested; {names['task']} on {names['dataset']} from all points."
    title += f" ({group.about})" if group.about else ""
    below = dirty_line(any(record.git["dirty"] for record in found))
    return Grid(title, list(table), table.to_numpy().tolist(), below)


def _sortable(values: pd.Series) -> pd.Series:
    """Return numbers as they are, and other values as texts."""
    return values if is_numeric_dtype(values) else values.map(str, na_action="ignore")


def _row(records: list[RunRecord], settings: Iterable[Any], metrics: list[MetricInfo]) -> list[str]:
    """Return the cells of one net, over all its seeds."""
    first = records[0]
    label = [collect.names(first)["net"], *settings, _points(first)]
    texts = ["" if value is None else str(value) for value in label]
    for metric in metrics:
        values = pd.Series([one.metrics.get(f"test/{FULL}/{metric.name}") for one in records])
        count = values.count()
        text = over_seeds(metric, values.mean(), values.std()) if count else ""
        if count > 1:
            text += f" (n={count})"
        if count and any(record.git["dirty"] for record in records):
            text += f" {DIRTY}"
        texts.append(text)
    size = first.parameters.get("task")
    cost = pd.Series(training_time(records)[1], dtype=float).mean()
    texts.append("" if size is None else f"{4e-6 * size:.1f}")
    return [*texts, "" if pd.isna(cost) else f"{cost:,.0f} s", _paper(first)]


def _settings(found: list[RunRecord]) -> list[dict[str, Any]]:
    """Return the settings of every record's net, and of its training where these distinguish runs.

    Settings of the training differ between runs of one net and seed, and are set in every record.
    """
    same: dict[tuple[str, ...], list[RunRecord]] = {}
    nets = [_net(record) for record in found]
    for record, net in zip(found, nets, strict=True):
        place = collect.names(record)["net"], net, _points(record), seed(record)
        same.setdefault(tuple(map(str, place)), []).append(record)
    trainings = sorted(
        key
        for key in {key for runs in same.values() for key in comparable.varying(runs)}
        if all(comparable.value(record, key) is not None for record in found)
    )
    for record, net in zip(found, nets, strict=True):
        for key in trainings:
            name = key.removesuffix("._target_")
            text = comparable.value(record, key)
            net[name] = text if name == key else text.rpartition(".")[2]
    return nets


def _net(record: RunRecord) -> dict[str, Any]:
    """Return the dotted settings of a net; of a sampler inside it, also the name of its module."""
    net: dict[str, Any] = {}
    for key, value in dotted(_arguments(record)).items():
        part, _, name = key.rpartition(".")
        if name == "_target_":
            net |= {part: str(value).split(".")[-2:][0]} if part else {}
        else:
            net[NAMES.get(key, key)] = "none" if part and value is None else value
    return net


def _arguments(record: RunRecord) -> dict[str, Any]:
    return record.config["task"].get("net") or {}


def _points(record: RunRecord) -> int | None:
    return record.config["dataset"].get("n_points")


def _metrics(found: list[RunRecord], requested: Sequence[str]) -> list[MetricInfo]:
    """Return the metrics of full clouds: the requested ones, or all of the closing table."""
    names = {name for record in found for name in record.metrics}
    known = {name.rsplit("/", 1)[1] for name in names if name.startswith(f"test/{FULL}/")}
    for name in requested:
        if name not in known:
            raise UserError(f"--metric: no run has {name!r}.{did_you_mean(name, known)}")
    if requested:
        return [metric_info(name, found) for name in requested]
    infos = in_summary_order(metric_info(name, found) for name in known)
    return [info for info in infos if info.full_cloud_metric is None]  # the rest is 1 here


def _paper(record: RunRecord) -> str:
    names = collect.names(record)
    points = _points(record)
    values = None
    if names["task"] == "reconstruction":
        values = paper.net(names["net"], _arguments(record).get("pieces"), points)
    if values:
        return " / ".join(f"{value:g}" for value in values)
    metric = score([record])
    theirs = paper.published(names["task"], names["net"], names["dataset"], metric).get("full")
    return "" if theirs is None else f"{theirs:.2f}"
