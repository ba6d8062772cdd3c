"""From records to tables: by size, by another setting, as a plane of two, by net, or of nets."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.metric_info import metric_info
from mops_lightning.records.readout_names import FULL, parse_metric_name
from mops_lightning.records.run_record import RunRecord
from mops_lightning.report import paper
from mops_lightning.report.collect import (
    Found,
    collect,
    epochs,
    sampler_row,
    score,
    seed,
    trained_with,
)
from mops_lightning.report.comparable import (
    Group,
    commit,
    groups,
    net_groups,
    value,
    weightless,
)
from mops_lightning.report.nets import nets_grid
from mops_lightning.report.tables import Table, make_table, net_labels, sort_key
from mops_lightning.report.text import PAPER, Grid

MAX_NAMED = 8
"""Most runs listed by name that were made in the same way."""


@dataclass(frozen=True)
class Report:
    """The content of a folder's report.

    Attributes:
        found: the runs.
        tables: one for each group of comparable runs and metric; none for task nets alone.
        grids: the texts of all tables.
        remarks: how the runs were made, and which have no result.
    """

    found: Found
    grids: list[Grid]
    remarks: list[str]
    tables: list[Table] = field(default_factory=list)


def build_report(folder: Path, metrics: Iterable[str] = (), mixed: bool = False) -> Report:
    """Make the tables of all completed records below ``folder``, one for each group and metric.

    Args:
        folder: the records' folder.
        metrics: names of the metrics to show; none: the main metric of the records' task.
        mixed: whether runs of different commits and settings may be in one table.

    Raises:
        UserError: there is no record, or no record has a metric.
    """
    found = collect(folder)
    last = _without_result(found)
    chosen = list(metrics)
    scored = [record for record in found.done if record.config["learn"] != "task"]
    if not scored:
        parts = net_groups(found.done, mixed)
        grids = [nets_grid(part, chosen) for part in parts]
        return Report(found, grids, [*_provenance(found.done, ""), *_joining(parts), *last])
    parts = groups(scored, mixed)
    tables = [
        make_table(part, metric, _net(part))
        for part in parts
        for metric in chosen or [score(part.records)]
    ]
    grids = [grid for table in tables for grid in _grids(table)]
    tasks = {record.config["names"]["task"] for record in scored}
    same = [record for record in found.done if record.config["names"]["task"] in tasks]
    hidden = sorted({folder for table in tables for folder in table.hidden})
    lines = [f"- {one}: not shown; a later run has the same row, column and seed" for one in hidden]
    net = tables[0].net if len({table.net for table in tables}) == 1 else ""
    made = _provenance(same, net)
    return Report(found, grids, [*made, *lines, *_joining(parts), *last], tables)


def _joining(parts: list[Group]) -> list[str]:
    """Return lines about separate tables."""
    if len(parts) == 1:
        return []
    return [
        "",
        f"{len(parts)} groups of runs are not comparable and have tables of their own. --mixed "
        "joins groups that differ in commit or settings only.",
    ]


def _net(group: Group) -> str:
    """Return the task net of a group's table; empty for a table by net."""
    if group.layout.column == "net":
        return ""
    trained = [record for record in group.records if not weightless(record)] or group.records
    return trained[0].config["names"]["net"]


def _grids(table: Table) -> list[Grid]:
    """Return the texts of a table, with the values of full clouds."""
    layout = table.group.layout
    if layout.planes:
        grids = [_plane(table, name) for name in sorted(layout.planes, key=sort_key)]
        grids[-1].below += _full_lines(table)
    elif layout.column == "net":
        grids = [_by_net(table)]
    else:
        grids = [_by_column(table)]
    about = f" ({table.group.about})" if table.group.about else ""
    for grid in grids:
        grid.title += about
    return grids


def _by_column(table: Table) -> Grid:
    names, layout = _names(table), table.group.layout
    joint = trained_with(table.group.records[0]) == "joint"
    published = paper.published(names["task"], names["dataset"], table.metric.name, joint)
    samplers = {sampler_row(one): one.config["names"]["sampler"] for one in table.group.records}
    cells, columns, costs = table.cells(["row"]), table.columns(), _costs(table)
    rows: list[list] = []
    for name in table.rows():
        own = cells.loc[name, columns]
        rows.append([name, *own, *([costs.get(name, "")] if costs else [])])
        sampler = samplers.get(name, name.partition(" from ")[0])
        theirs = published.get("rows", {}).get(sampler, {}) if layout.column == "m" else {}
        if any(str(column) in theirs for column in columns):
            values = [theirs.get(str(column), []) for column in columns]
            texts = [" / ".join(f"{one:.2f}" for one in cell) for cell in values]
            rows.append([PAPER, *texts, *([""] if costs else [])])
    below = [published["note"]] if "note" in published and any(r[0] == PAPER for r in rows) else []
    size = "" if layout.column == "m" else f", m={names['m']},"
    title = (
        f"Test {table.metric.title}: {names['task']} on {names['dataset']}{size} "
        f"under {table.net}; generated / matched / completed sets, or one figure for "
        "samplers that choose input points."
    )
    head = ["sampled by", *(f"{layout.column}={one}" for one in columns)]
    if layout.column == "m":
        below += _full_lines(table)
    else:
        rows.append(_full_row(table))
    return Grid(title, head + ["training"] * bool(costs), rows, below)


def _by_net(table: Table) -> Grid:
    """Return the scores of the same samples under several nets: size and sampler by net."""
    names, cells = _names(table), table.cells(["m", "row"])
    labels, records = net_labels(table.group.records), table.group.records
    columns = sorted(cells.columns, key=lambda label: ("of the training" not in label, label))
    rows: list[list] = [
        [str(m), name, *cells.loc[(m, name), columns]]
        for m, name in sorted(cells.index, key=lambda one: (-one[0], sort_key(one[1])))
    ]
    full = _full_metric(table)
    label = f"all points ({full.title})" if table.metric.full_cloud_metric else "all points"
    figures = [record.metrics.get(f"test/{FULL}/{full.name}") for record in records]
    # Figures differ by seed where data depend on it; equal ones are of the same data.
    tested = pd.DataFrame({"net": labels, "figure": figures}).dropna().drop_duplicates()
    by_net = tested.groupby("net")["figure"].mean().map(full.format)
    means = [by_net.get(name, "") for name in columns]
    title = (
        f"Test {table.metric.title} of the same samples under several task nets: {names['task']} "
        f"on {names['dataset']}; generated / matched / completed sets, or one figure for samplers "
        "that choose input points."
    )
    return Grid(title, ["m", "sampled by", *columns], [*rows, ["", label, *means]])


def _plane(table: Table, name: str) -> Grid:
    """Return the grid of a sampler: rows are one setting's values, columns the other's."""
    names, (down, across) = _names(table), table.group.layout.planes[name]
    cells = table.cells(["row", "down"]).loc[name].sort_index().sort_index(axis=1)
    cells = cells.loc[:, (cells != "").any()]
    rows: list[list] = [
        [f"{left:g}", *line] for left, line in zip(cells.index, cells.to_numpy(), strict=True)
    ]
    title = (
        f"Test {table.metric.title} of {name}: {names['task']} on {names['dataset']}, "
        f"m={names['m']}, under {table.net}; generated / matched / completed sets."
    )
    corner = f"{down.split('.')[-1]} \\ {across.split('.')[-1]}"
    head = [corner, *(f"{one:g}" for one in cells.columns)]
    return Grid(title, head, rows, [_spread(table, name)])


def _spread(table: Table, name: str) -> str:
    """Return the range of a heat map's values by readout: a measure of sensitivity."""
    parts = []
    for readout in table.readouts(name):
        means = table.of(name, readout)["mean"]
        low, high = means.min(), means.max()
        times = f" (factor {high / low:.3g})" if low > 0 else ""
        parts.append(f"{readout} {table.metric.format(low)} to {table.metric.format(high)}{times}")
    return f"Spread over the plane of {name}: {', '.join(parts)}."


def _costs(table: Table) -> dict[str, str]:
    """Return the seconds of training of every row by size, over all its runs, per seed."""
    rows = [
        {"row": sampler_row(one), "seed": one.seed, "fit": one.seconds["fit"]}
        for one in table.group.records
        if "fit" in one.seconds
    ]
    if table.group.layout.column != "m" or not rows:
        return {}
    by_row = pd.DataFrame(rows).groupby("row")
    costs = by_row["fit"].sum() / by_row["seed"].nunique()
    return costs.map("{:,.0f} s".format).to_dict()


def _full_row(table: Table) -> list[str]:
    """Return the task net's values on full clouds, by the setting of the columns."""
    key, name = table.group.layout.column, f"test/{FULL}/{table.metric.name}"
    figures = [(value(one, key), one.metrics.get(name)) for one in table.group.records]
    texts = {column: table.metric.format(one) for column, one in figures if one is not None}
    return ["all points", *(texts.get(column, "") for column in table.columns())]


def _full_lines(table: Table) -> list[str]:
    """Return a line for each task net with its value on full clouds."""
    names, records, metric = _names(table), table.group.records, _full_metric(table)
    joint = trained_with(records[0]) == "joint"
    theirs = paper.published(names["task"], names["dataset"], metric.name, joint)
    label = f"{metric.title} " if table.metric.full_cloud_metric else ""
    lines = []
    for record in sorted(records, key=lambda one: (sampler_row(one), -one.config["m"])):
        figure = record.metrics.get(f"test/{FULL}/{metric.name}")
        if figure is None:
            continue
        net = record.config["names"]["net"]
        after = ""
        if trained_with(record) == "joint":
            several = any(parts.m for parts in map(parse_metric_name, record.metrics) if parts)
            size = "" if several else f", m={record.config['m']}"
            after = f" after joint training with {sampler_row(record)}{size}"
        published = net == table.net and "full" in theirs
        compared = f" (the paper: {theirs['full']:.2f})" if published else ""
        lines.append(f"{net} on all points{after}: {label}{metric.format(figure)}{compared}.")
    return list(dict.fromkeys(lines))


def _full_metric(table: Table) -> MetricInfo:
    """Return the metric of full clouds, whose errors normalized by the full cloud are always 1."""
    name = table.metric.full_cloud_metric or table.metric.name
    return metric_info(name, table.group.records)


def _names(table: Table) -> dict[str, str]:
    """Return what the records share: names of task and dataset; and their sizes."""
    names = table.group.records[0].config["names"]
    sizes = "/".join(str(m) for m in sorted({one.config["m"] for one in table.group.records}))
    return {"task": names["task"], "dataset": names["dataset"], "m": sizes}


def _provenance(found: list[RunRecord], net: str) -> list[str]:
    """Return a line for each way in which runs were made: epochs, seed, device, commit.

    If runs of one kind were made in several ways, the lines name their folders.

    Args:
        found: completed records.
        net: the table's task net; other nets are named.
    """
    rows = [(_kind(record, net), _way(record), Path(record.folder).name) for record in found]
    made = pd.DataFrame(rows, columns=["kind", "way", "folder"])
    lines = []
    for kind, runs in made.groupby("kind", sort=False):
        ways = runs.groupby("way", sort=False)["folder"]
        for way, folders in ways:
            named = len(ways) > 1 and len(folders) <= MAX_NAMED
            listed = f" ({', '.join(folders)})" if named else ""
            lines.append(f"- {kind}{listed}: {way}")
    return lines


def _kind(record: RunRecord, net: str) -> str:
    names = record.config["names"]
    kind = names["net"] if record.config["learn"] == "task" else sampler_row(record)
    if names["net"] not in (net, kind):
        kind += f" under {names['net']}"
    joint = trained_with(record) == "joint" and "fit" in record.seconds
    return f"{kind}, jointly trained" if joint else kind


def _way(record: RunRecord) -> str:
    length = "nothing to train"
    if (number := epochs(record)) is not None:
        evaluated = "" if "fit" in record.seconds else "evaluated after "
        length = f"{evaluated}{number} {'epoch' if number == 1 else 'epochs'}"
    threads = "thread" if record.threads == 1 else "threads"
    changes = " with changes" if record.git["dirty"] else ""
    return (
        f"{length}, seed {seed(record)}, {record.device}, {record.threads} {threads}, "
        f"commit {commit(record)}{changes}"
    )


def _without_result(found: Found) -> list[str]:
    """Return a line for each run that is not completed, and their number."""
    if not found.undone:
        return []
    lines = [f"- {folder}: {why}" for folder, why in found.undone.items()]
    verb = "is" if len(lines) == 1 else "are"
    number = len(found.done) + len(lines)
    return ["", f"{len(lines)} of {number} runs {verb} not completed:", "", *lines]
