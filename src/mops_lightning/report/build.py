"""From records to tables: by size, by another setting, as a plane of two, by net, or of nets."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from mops_lightning.records.readout_names import (
    FULL,
    GENERATED_READOUTS,
    PROJECTED,
    parse_metric_name,
)
from mops_lightning.records.run_record import RunRecord
from mops_lightning.records.summary import OF_TEST_CLOUDS
from mops_lightning.report import collect, paper
from mops_lightning.report.comparable import Group, commit, groups, net_groups, weightless
from mops_lightning.report.nets import nets_grid
from mops_lightning.report.tables import Table, make_table, sort_key
from mops_lightning.report.text import PAPER, Grid

MAX_COLUMNS = 8
"""Most values of a setting that a table shows side by side; more are below each other."""

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

    found: collect.Found
    tables: list[Table]
    grids: list[Grid]
    remarks: list[str]


def build_report(folder: Path, metrics: Iterable[str] = (), mixed: bool = False) -> Report:
    """Make the tables of all completed records below ``folder``, one for each group and metric.

    Args:
        folder: the records' folder.
        metrics: names of the metrics to show; none: the main metric of the records' task.
        mixed: whether runs of different commits and settings may be in one table.

    Raises:
        UserError: there is no record, or no record has a metric.
    """
    found = collect.collect(folder)
    chosen = list(metrics)
    scored = [record for record in found.done if record.config["learn"] != "task"]
    parts = groups(scored, mixed) if scored else net_groups(found.done, mixed)
    measured = collect.tested_metrics(scored)
    tables = [
        make_table(part, metric, _net(part))
        for part in parts
        for metric in chosen or [collect.score(part.records)]
        # A metric of one task only has tables for it; make_table refuses an unknown one.
        if scored and (metric not in measured or metric in collect.tested_metrics(part.records))
    ]
    grids = [grid for table in tables for grid in _grids(table)]
    if not scored:
        grids = [nets_grid(part, chosen) for part in parts]
    tasks = {record.config["names"]["task"] for record in scored or found.done}
    same = [record for record in found.done if record.config["names"]["task"] in tasks]
    nets = {table.net for table in tables}
    hidden = sorted({folder for table in tables for folder in table.hidden})
    remarks = [
        *_provenance(same, nets.pop() if len(nets) == 1 else ""),
        *(f"- {one}: not shown; a later run has the same row, column and seed" for one in hidden),
    ]
    if len(parts) > 1:
        remarks += [
            "",
            f"{len(parts)} groups of runs are not comparable and have tables of their own. "
            "--mixed joins groups that differ in commit or settings only.",
        ]
    return Report(found, tables, grids, [*remarks, *_without_result(found)])


def _net(group: Group) -> str:
    """Return the task net of a group's table; empty for a table by net."""
    if group.column == "net":
        return ""
    trained = [record for record in group.records if not weightless(record)] or group.records
    return trained[0].config["names"]["net"]


def _grids(table: Table) -> list[Grid]:
    """Return the texts of a table, with the values of full clouds."""
    if table.group.planes:
        grids = [_plane(table, name) for name in sorted(table.group.planes, key=sort_key)]
        grids[-1].below += _full_lines(table)
    else:
        grids = [_by_net(table) if table.group.column == "net" else _by_column(table)]
    grids[-1].below += [*_level_line(table), *_unchanged_lines(table)]
    if table.group.about:
        for grid in grids:
            grid.title += f" ({table.group.about})"
    return grids


def _level_line(table: Table) -> list[str]:
    """Return a line that says what bold means, if a value is bold and not the best."""
    if not table.values["level"].any():
        return []
    return [
        "Bold: the best value, and those level with it, less than two standard deviations over "
        "seeds away."
    ]


def _unchanged_lines(table: Table) -> list[str]:
    """Return a line for each sampler whose cells are equal, though its settings differ."""
    lines = []
    for name in table.rows() if table.group.settings else ():
        values = table.values[table.values["row"] == name]
        shown = values["mean"].map(table.metric.format).groupby(values["readout"])
        if shown.nunique().max() == 1 and shown.count().min() > 1:
            lines.append(
                f"All {shown.count().max()} cells of {name} are equal: the settings that differ "
                "changed no figure."
            )
    return lines


def _sets(table: Table) -> str:
    """Return the content of a cell, for titles."""
    order = " / ".join(GENERATED_READOUTS)
    if PROJECTED in set(table.values["readout"]):
        order += f" (SampleNet: / {PROJECTED})"
    return f"{order} sets, or one figure for samplers that choose input points."


def _by_column(table: Table) -> Grid:
    """Return the scores of all samplers by size or by another setting, beside the paper's."""
    names, by_size, records = table.names, table.group.column == "m", table.group.records
    published = _published(table) if by_size else {}
    samplers = {collect.sampler_row(one): one.config["names"]["sampler"] for one in records}
    cells, columns, costs = table.cells(["row"]), table.columns(), _costs(table)
    rows: list[list] = []
    below: list[str] = []
    for name in table.rows():
        rows.append([name, *cells.loc[name, columns], *([costs.get(name, "")] if costs else [])])
        sampler = samplers.get(name, name.partition(" from ")[0])
        theirs = published.get("rows", {}).get(sampler, {})
        values = [theirs.get(str(column), []) for column in columns]
        if any(values):
            texts = [" / ".join(f"{one:.2f}" for one in cell) for cell in values]
            rows.append([PAPER, *texts, *([""] if costs else [])])
            below = [published["note"]] if "note" in published else []
    if by_size:
        below += _full_lines(table)
    else:
        full = table.full[table.full["metric"] == table.metric.name]
        texts = full.groupby("column")["value"].last().map(table.metric.format).to_dict()
        rows.append(["all points", *(texts.get(column, "") for column in columns)])
    size = "" if by_size else f", m={table.sizes},"
    title = (
        f"Test {table.metric.title}: {names['task']} on {names['dataset']}{size} "
        f"under {table.net}; {_sets(table)}"
    )
    head = ["sampled by", *(f"{table.group.column}={one}" for one in columns)]
    if costs:
        head.append(collect.training_time(records)[0])
    if not by_size and len(columns) > MAX_COLUMNS:
        head = [table.group.column, *(row[0] for row in rows)]
        rows = [list(line) for line in zip(columns, *(row[1:] for row in rows), strict=True)]
    return Grid(title, head, rows, below)


def _by_net(table: Table) -> Grid:
    """Return the scores of the same samples under several nets: size and sampler by net."""
    names, cells = table.names, table.cells(["m", "row"])
    columns = sorted(cells.columns, key=lambda label: ("of the training" not in label, label))
    rows: list[list] = [
        [str(m), name, *cells.loc[(m, name), columns]]
        for m, name in sorted(cells.index, key=lambda one: (-one[0], sort_key(one[1])))
    ]
    metric = table.full_metric
    label = f"all points ({metric.title})" if table.metric.full_cloud_metric else "all points"
    full = table.full[table.full["metric"] == metric.name]
    # Figures differ by seed where data depend on it; equal ones are of the same data.
    tested = full.drop_duplicates(["net", "value"]).groupby("net")["value"]
    means = tested.mean().map(metric.format).to_dict()
    title = (
        f"Test {table.metric.title} of the same samples under several task nets: {names['task']} "
        f"on {names['dataset']}; {_sets(table)}"
    )
    rows.append(["", label, *(means.get(name, "") for name in columns)])
    return Grid(title, ["m", "sampled by", *columns], rows)


def _plane(table: Table, name: str) -> Grid:
    """Return the grid of a sampler: rows are one setting's values, columns the other's.

    Below it is the range of its values by readout, a measure of sensitivity.
    """
    names, (down, across) = table.names, table.group.planes[name]
    cells = table.cells(["row", "down"]).loc[name].sort_index().sort_index(axis=1)
    cells = cells.loc[:, (cells != "").any()]
    rows = [[f"{left:g}", *line] for left, line in zip(cells.index, cells.to_numpy(), strict=True)]
    spreads = []
    for readout in table.readouts(name):
        means = table.of(name, readout)["mean"]
        low, high = means.min(), means.max()
        times = f" (factor {high / low:.3g})" if low > 0 else ""
        ends = f"{table.metric.format(low)} to {table.metric.format(high)}"
        spreads.append(f"{readout} {ends}{times}")
    title = (
        f"Test {table.metric.title} of {name}: {names['task']} on {names['dataset']}, "
        f"m={table.sizes}, under {table.net}; {' / '.join(table.readouts(name))} sets."
    )
    corner = f"{down.split('.')[-1]} \\ {across.split('.')[-1]}"
    head = [corner, *(f"{one:g}" for one in cells.columns)]
    return Grid(title, head, rows, [f"Spread over the plane of {name}: {', '.join(spreads)}."])


def _costs(table: Table) -> dict[str, str]:
    """Return the seconds of training of every row by size: of all its trainings, for one seed."""
    if table.group.column != "m":
        return {}
    records = table.group.records
    trained = [one.config["sampler"].get("m_max", one.config["m"]) for one in records]
    runs = pd.DataFrame({"row": map(collect.sampler_row, records), "m": trained})
    runs["seconds"] = collect.training_time(records)[1]
    costs = runs.dropna().groupby(["row", "m"])["seconds"].mean().groupby("row").sum()
    return costs.map("{:,.0f} s".format).to_dict()


def _full_lines(table: Table) -> list[str]:
    """Return a line for each task net with its value on full clouds."""
    metric, theirs = table.full_metric, _published(table, full_clouds=True)
    label = f"{metric.title} " if table.metric.full_cloud_metric else ""
    lines = []
    for record in sorted(
        table.group.records, key=lambda one: (collect.sampler_row(one), -one.config["m"])
    ):
        figure = record.metrics.get(f"test/{FULL}/{metric.name}")
        if figure is None:
            continue
        net = record.config["names"]["net"]
        after = ""
        if collect.trained_with(record) == "joint":
            several = any(parts.m for parts in map(parse_metric_name, record.metrics) if parts)
            size = "" if several else f", m={record.config['m']}"
            after = f" after joint training with {collect.sampler_row(record)}{size}"
        published = net == table.net and "full" in theirs
        compared = f" (the paper: {theirs['full']:.2f})" if published else ""
        lines.append(f"{net} on all points{after}: {label}{metric.format(figure)}{compared}.")
    return list(dict.fromkeys(lines))


def _published(table: Table, full_clouds: bool = False) -> dict[str, Any]:
    """Return the paper's table; empty if it has none, and for test clouds that were changed."""
    if any(one.config.get(key) for one in table.group.records for key in OF_TEST_CLOUDS):
        return {}
    metric = table.full_metric if full_clouds else table.metric
    joint = collect.trained_with(table.group.records[0]) == "joint"
    names = table.names
    return paper.published(names["task"], table.net, names["dataset"], metric.name, joint)


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
    kind = names["net"] if record.config["learn"] == "task" else collect.sampler_row(record)
    if names["net"] not in (net, kind):
        kind += f" under {names['net']}"
    joint = collect.trained_with(record) == "joint" and "fit" in record.seconds
    return f"{kind}, jointly trained" if joint else kind


def _way(record: RunRecord) -> str:
    length = "nothing to train"
    if (number := collect.epochs(record)) is not None:
        evaluated = "" if "fit" in record.seconds else "evaluated after "
        length = f"{evaluated}{number} {'epoch' if number == 1 else 'epochs'}"
    threads = "thread" if record.threads == 1 else "threads"
    changes = " with changes" if record.git["dirty"] else ""
    return (
        f"{length}, seed {collect.seed(record)}, {record.device}, {record.threads} {threads}, "
        f"commit {commit(record)}{changes}"
    )


def _without_result(found: collect.Found) -> list[str]:
    """Return a line for each run without a full result, and their number."""
    if not found.undone:
        return []
    lines = [f"- {folder}: {why}" for folder, why in found.undone.items()]
    verb = "has" if len(lines) == 1 else "have"
    number = len(found.done) + len(lines)
    return ["", f"{len(lines)} of {number} runs {verb} no full result:", "", *lines]
