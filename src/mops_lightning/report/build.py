"""From records to tables: by size, by another setting, as a plane of two, or of task nets."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.metric_info import metric_info
from mops_lightning.records.readout_names import FULL, GENERATED_READOUTS
from mops_lightning.report import paper
from mops_lightning.report.axes import Axes, axes, value
from mops_lightning.report.cells import Cells, cells, place
from mops_lightning.report.collect import (
    Found,
    Record,
    collect,
    common,
    epochs,
    learned,
    score,
    seed,
)
from mops_lightning.report.nets import nets_grid
from mops_lightning.report.text import PAPER, Grid

NAMED = 8
"""Runs that were made in one way are named up to this number."""


@dataclass(frozen=True)
class Report:
    """All that is shown of a folder.

    Attributes:
        found: the runs.
        scored: the records in the tables.
        names: what these share; see ``collect.common``. Empty for task nets alone.
        axes: how the tables are laid out.
        tables: one for each metric; none for task nets alone.
        grids: their texts.
        remarks: how the runs were made, and which have no result.
    """

    found: Found
    scored: list[Record]
    names: dict[str, str]
    axes: Axes
    tables: list[Cells]
    grids: list[Grid]
    remarks: list[str]


def build(folder: Path, metrics: Iterable[str] = (), mixed: bool = False) -> Report:
    """Make the tables of all completed records below ``folder``, one for each metric.

    Args:
        folder: the records' folder.
        metrics: what is shown; none: the score of the records' task.
        mixed: whether runs of different commits and settings may stand in one table.

    Raises:
        UserError: there is no record, or records whose figures must not stand in one table.
    """
    found = collect(folder)
    scored = [record for record in found.done if record["config"]["learn"] != "task"]
    if not scored:
        remarks = [*how(found.done, ""), *_undone(found)]
        return Report(
            found, [], {}, Axes(), [], [nets_grid(found.done, list(metrics), mixed)], remarks
        )
    names = common(scored, mixed)
    layout = axes(scored, names["net"], mixed)
    shown = list(metrics) or [score(scored)]
    tables = [cells(scored, metric, names["net"], layout) for metric in shown]
    grids = []
    for table in tables:
        grids += (
            _planes(table, names, layout) if layout.planes else [_by_column(table, names, layout)]
        )
        if layout.column == "m":
            grids[-1].below += _full(scored, names, table.metric)
        else:
            grids[-1].rows.append(_full_row(scored, table, layout))
    same = [r for r in found.done if r["config"]["names"]["task"] == names["task"]]
    return Report(
        found, scored, names, layout, tables, grids, [*how(same, names["net"]), *_undone(found)]
    )


def _by_column(table: Cells, names: dict[str, str], layout: Axes) -> Grid:
    columns = table.columns()
    if layout.column != "m":
        columns = columns[::-1]
    published = paper.table(
        names["task"], names["dataset"], table.metric.name, names["learned"] == "joint"
    )
    rows = []
    for name in table.rows():
        rows.append([name, *(table.text(name, column) for column in columns)])
        theirs = published.get("rows", {}).get(name, {}) if layout.column == "m" else {}
        if any(str(column) in theirs for column in columns):
            figures = [theirs.get(str(column), []) for column in columns]
            texts = [" / ".join(f"{one:.2f}" for one in values) for values in figures]
            rows.append([PAPER, *texts])
    size = "" if layout == Axes() else f", m={names['m']},"
    title = (
        f"Test {table.metric.title}: {names['task']} on {names['dataset']}{size} "
        f"under {names['net']}; generated / matched / completed sets, or one figure for "
        "samplers that choose input points."
    )
    return Grid(title, ["sampled by", *(f"{layout.column}={one}" for one in columns)], rows)


def _planes(table: Cells, names: dict[str, str], layout: Axes) -> list[Grid]:
    """Return one grid per sampler: rows are one setting's values, columns the other's."""
    assert layout.planes is not None
    grids = []
    for name in sorted(layout.planes, key=place):
        down, across = layout.planes[name]
        columns = sorted({column[1] for column in table.figures[name]})
        rows = [
            [f"{left}", *(table.text(name, (left, top)) for top in columns)]
            for left in sorted({column[0] for column in table.figures[name]})
        ]
        title = (
            f"Test {table.metric.title} of {name}: {names['task']} on "
            f"{names['dataset']}, m={names['m']}, "
            f"under {names['net']}; generated / matched / completed sets."
        )
        head = [f"{down.split('.')[-1]} \\ {across.split('.')[-1]}", *map(str, columns)]
        grids.append(Grid(title, head, rows, [spread(table, name)]))
    return grids


def spread(table: Cells, name: str) -> str:
    """Say how far the figures of a heat map lie apart, by readout: a number for (in)sensitivity."""
    parts = []
    for readout, values in plane(table, name).items():
        low, high = min(values.values()), max(values.values())
        ends = [table.metric.format(end) for end in (low, high)]
        span = " to ".join(ends)
        times = f" (factor {high / low:.3g})" if low > 0 else ""
        parts.append(f"{readout} {span}{times}")
    return f"Spread over the plane of {name}: {', '.join(parts)}."


def plane(table: Cells, name: str) -> dict[str, dict[Any, float]]:
    """Return readout → column → mean over seeds for one row of a table."""
    found: dict[str, dict[Any, float]] = {}
    for column, readouts in table.figures[name].items():
        for readout, by_seed in readouts.items():
            found.setdefault(readout, {})[column] = sum(by_seed.values()) / len(by_seed)
    return {name: found[name] for name in (*GENERATED_READOUTS, *found) if name in found}


def _full_row(found: list[Record], table: Cells, layout: Axes) -> list[str]:
    """Return what the task net scores on all points at every value of the setting."""
    shown = {}
    for record in found:
        figure = record["metrics"].get(f"test/{FULL}/{table.metric.name}")
        if figure is not None:
            shown[value(record, layout.column)] = table.metric.format(figure)
    return ["all points", *(shown.get(column, "") for column in table.columns()[::-1])]


def _full(found: list[Record], names: dict[str, str], metric: MetricInfo) -> list[str]:
    """Say what the task nets score on all points."""
    joint = names["learned"] == "joint"
    theirs = paper.table(names["task"], names["dataset"], metric.name, joint)
    published = f" (the paper: {theirs['full']:.2f})" if "full" in theirs else ""
    lines: dict[str, None] = {}
    other = metric.full_cloud_metric
    if other:
        metric = metric_info(other, found)
    for record in found:
        figure = record["metrics"].get(f"test/{FULL}/{metric.name}")
        config = record["config"]["names"]
        with_ = (
            f" after joint training with {config['sampler']}" if learned(record) == "joint" else ""
        )
        if figure is not None:
            shown = metric.format(figure)
            shown = f"{metric.title} {shown}" if other else shown
            shown += published if config["net"] == names["net"] else ""
            lines[f"{config['net']} on all points{with_}: {shown}."] = None
    return list(lines)


def how(found: Iterable[Record], net: str) -> list[str]:
    """Say how each kind of run was made: epochs, seeds, device, commit; other nets are named.

    Where runs of one kind were made in several ways, the lines name their folders.
    """
    made: dict[str, dict[str, list[str]]] = {}
    for record in found:
        config, names = record["config"], record["config"]["names"]
        what = names["net"] if config["learn"] == "task" else names["sampler"]
        trained = "fit" in record["seconds"]
        if names["net"] not in (net, what):
            what += f" under {names['net']}"
        joint = ", jointly trained" if learned(record) == "joint" and trained else ""
        length = "nothing to train, " if epochs(record) is None else f"{epochs(record)} epochs, "
        if not trained and epochs(record) is not None:
            length = f"evaluated after {length}"
        commit = (record["git"]["commit"] or "a wheel")[:10]
        way = (
            f"{length}seed {seed(record)}, {record['device']}, {record['threads']} threads, "
            f"commit {commit}" + (" with changes" if record["git"]["dirty"] else "")
        )
        made.setdefault(what + joint, {}).setdefault(way, []).append(Path(record["folder"]).name)
    lines = []
    for kind, ways in made.items():
        for way, folders in ways.items():
            those = f" ({', '.join(folders)})" if len(ways) > 1 and len(folders) <= NAMED else ""
            lines.append(f"- {kind}{those}: {way}")
    return lines


def _undone(found: Found) -> list[str]:
    if not found.undone:
        return []
    lines = [f"- {folder}: {why}" for folder, why in found.undone.items()]
    return ["", f"{len(lines)} of {found.count} runs are not completed:", "", *lines]
