"""From records to tables: by size, by another setting, as a plane of two, or of task nets."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from mops_lightning.errors import UserError
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.metric_info import metric_info
from mops_lightning.records.readout_names import FULL, parse
from mops_lightning.records.run_record import RunRecord
from mops_lightning.report import paper
from mops_lightning.report.axes import Axes, axes, value
from mops_lightning.report.cells import Cells, make_cells, sort_key
from mops_lightning.report.collect import Found, collect, sampler_row, score, trained_with
from mops_lightning.report.comparable import shared_names
from mops_lightning.report.nets import nets_grid
from mops_lightning.report.provenance import provenance, without_result
from mops_lightning.report.text import PAPER, Grid
from mops_lightning.report.transfer import transfer_grid
from mops_lightning.report.windows import equal_ratios
from mops_lightning.viz.snapshots import load_clouds


@dataclass(frozen=True)
class Report:
    """The content of a folder's report.

    Attributes:
        found: the runs.
        scored: the records in the tables.
        names: what these share; see ``comparable.shared_names``. Empty for task nets alone.
        axes: the layout of the tables.
        tables: one for each metric; none for task nets alone.
        grids: their texts.
        remarks: how the runs were made, and which have no result.
    """

    found: Found
    scored: list[RunRecord]
    names: dict[str, str]
    axes: Axes
    tables: list[Cells]
    grids: list[Grid]
    remarks: list[str]


def build(folder: Path, metrics: Iterable[str] = (), mixed: bool = False) -> Report:
    """Make the tables of all completed records below ``folder``, one for each metric.

    Args:
        folder: the records' folder.
        metrics: names of the metrics to show; none: the main metric of the records' task.
        mixed: whether runs of different commits and settings are allowed in one table.

    Raises:
        UserError: there is no record, or the results are not comparable.
    """
    found = collect(folder)
    without_clouds = _without_bad_clouds(found.done)
    scored = [record for record in found.done if record.config["learn"] != "task"]
    if not scored:
        grid = nets_grid(found.done, list(metrics), mixed)
        remarks = [*provenance(found.done, ""), *without_result(found), *without_clouds]
        return Report(found, [], {}, Axes(), [], [grid], remarks)
    names = shared_names(scored, mixed)
    layout = axes(scored, names["net"], mixed)
    chosen = list(metrics) or [score(scored)]
    tables = [make_cells(scored, metric, names["net"], layout) for metric in chosen]
    grids = [grid for table in tables for grid in _grids(scored, table, names, layout)]
    same = [r for r in found.done if r.config["names"]["task"] == names["task"]]
    remarks = [*provenance(same, names["net"]), *without_result(found), *without_clouds]
    return Report(found, scored, names, layout, tables, grids, remarks)


def _without_bad_clouds(found: list[RunRecord]) -> list[str]:
    """Take clouds that cannot be read from the records, and return a line for each."""
    lines = []
    for record in found:
        path = Path(record.folder) / record.files.get("clouds", "")
        try:
            if path.is_file():
                load_clouds(path)
        except (OSError, UserError) as error:
            del record.files["clouds"]
            lines.append(f"- {error}")
    return ["", "Saved clouds that are not shown:", "", *lines] if lines else []


def _grids(found: list[RunRecord], table: Cells, names: dict[str, str], layout: Axes) -> list[Grid]:
    """Return the texts of one metric's table, with the values of full clouds."""
    if layout.planes:
        compared = equal_ratios(table, layout.planes)
        grids = [*_planes(table, names, layout), *([compared] if compared else [])]
    else:
        grids = [_by_column(found, table, names, layout)]
    if layout.column == "m":
        grids[-1].below += _full_lines(found, names, table.metric)
    else:
        grids[-1].rows.append(_full_row(found, table, layout))
    transferred = transfer_grid(found, table, names, layout)
    return [*grids, *([transferred] if transferred else [])]


def _by_column(found: list[RunRecord], table: Cells, names: dict[str, str], layout: Axes) -> Grid:
    columns = table.columns()
    if layout.column != "m":
        columns = columns[::-1]
    published = paper.table(
        names["task"], names["dataset"], table.metric.name, names["learned"] == "joint"
    )
    samplers = {sampler_row(one): one.config["names"]["sampler"] for one in found}
    rows = []
    for name in table.rows():
        rows.append([name, *(table.text(name, column) for column in columns)])
        sampler = samplers.get(name, name)
        theirs = published.get("rows", {}).get(sampler, {}) if layout.column == "m" else {}
        if any(str(column) in theirs for column in columns):
            values = [theirs.get(str(column), []) for column in columns]
            rows.append([PAPER, *(" / ".join(f"{one:.2f}" for one in cell) for cell in values)])
    below = [published["note"]] if "note" in published and any(r[0] == PAPER for r in rows) else []
    size = "" if layout == Axes() else f", m={names['m']},"
    title = (
        f"Test {table.metric.title}: {names['task']} on {names['dataset']}{size} "
        f"under {names['net']}; generated / matched / completed sets, or one figure for "
        "samplers that choose input points."
    )
    return Grid(title, ["sampled by", *(f"{layout.column}={one}" for one in columns)], rows, below)


def _planes(table: Cells, names: dict[str, str], layout: Axes) -> list[Grid]:
    """Return one grid per sampler: rows are one setting's values, columns the other's."""
    assert layout.planes is not None
    grids = []
    for name in sorted(layout.planes, key=sort_key):
        down, across = layout.planes[name]
        columns = sorted({column[1] for column in table.values[name]})
        rows = [
            [f"{left}", *(table.text(name, (left, top)) for top in columns)]
            for left in sorted({column[0] for column in table.values[name]})
        ]
        title = (
            f"Test {table.metric.title} of {name}: {names['task']} on {names['dataset']}, "
            f"m={names['m']}, under {names['net']}; generated / matched / completed sets."
        )
        head = [f"{down.split('.')[-1]} \\ {across.split('.')[-1]}", *map(str, columns)]
        grids.append(Grid(title, head, rows, [_spread(table, name)]))
    return grids


def _spread(table: Cells, name: str) -> str:
    """Return the range of a heat map's values by readout: a measure of sensitivity."""
    parts = []
    for readout, values in table.plane(name).items():
        low, high = min(values.values()), max(values.values())
        times = f" (factor {high / low:.3g})" if low > 0 else ""
        parts.append(f"{readout} {table.metric.format(low)} to {table.metric.format(high)}{times}")
    return f"Spread over the plane of {name}: {', '.join(parts)}."


def _full_row(found: list[RunRecord], table: Cells, layout: Axes) -> list[str]:
    """Return the task net's values on full clouds, by the setting of the columns."""
    texts = {}
    for record in found:
        figure = record.metrics.get(f"test/{FULL}/{table.metric.name}")
        if figure is not None:
            texts[value(record, layout.column)] = table.metric.format(figure)
    return ["all points", *(texts.get(column, "") for column in table.columns()[::-1])]


def _full_lines(found: list[RunRecord], names: dict[str, str], metric: MetricInfo) -> list[str]:
    """Return a line for each task net with its value on full clouds."""
    joint = names["learned"] == "joint"
    theirs = paper.table(names["task"], names["dataset"], metric.name, joint)
    published = f" (the paper: {theirs['full']:.2f})" if "full" in theirs else ""
    label = ""
    if metric.full_cloud_metric:
        metric = metric_info(metric.full_cloud_metric, found)
        label = f"{metric.title} "
    lines: dict[str, None] = {}  # a dictionary as a set in order
    for record in sorted(found, key=lambda one: (sampler_row(one), -one.config["m"])):
        figure = record.metrics.get(f"test/{FULL}/{metric.name}")
        if figure is None:
            continue
        net = record.config["names"]["net"]
        after = ""
        if trained_with(record) == "joint":
            several = any(parts.m for parts in map(parse, record.metrics) if parts)
            size = "" if several else f", m={record.config['m']}"
            after = f" after joint training with {sampler_row(record)}{size}"
        compared = published if net == names["net"] else ""
        lines[f"{net} on all points{after}: {label}{metric.format(figure)}{compared}."] = None
    return list(lines)
