"""From a table's values to its texts: by size, by another setting, as planes of two, or by net."""

from collections.abc import Sequence
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
from mops_lightning.report.rows import sort_key
from mops_lightning.report.tables import Table, dirty_line
from mops_lightning.report.text import PAPER, Grid

MAX_COLUMNS = 8
"""Most values of a setting that a table shows side by side; more are below each other."""


def grids(table: Table) -> list[Grid]:
    """Return the texts of a table, with the values of full clouds."""
    if table.group.planes:
        texts = [_plane(table, row) for row in sorted(table.planes, key=sort_key)]
        texts[-1].below += _full_lines(table)
    elif table.group.column == "net":
        texts = [_by_net(table)]
    else:
        texts = [_by_column(table)]
    texts[-1].below += _level_line(table)
    texts[-1].below += _unchanged_lines(table)
    texts[-1].below += dirty_line(table.values["dirty"].any())
    if table.group.about:
        for grid in texts:
            grid.title += f" ({table.group.about})"
    return texts


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
    if not table.group.settings:
        return []
    lines = []
    for row in table.rows():
        values = table.values[table.values["row"] == row]
        shown = values["mean"].map(table.metric.format).groupby(values["readout"])
        if shown.nunique().max() == 1 and shown.count().min() > 1:
            lines.append(
                f"All {shown.count().max()} cells of {row} are equal: the settings that differ "
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
    group = table.group
    is_by_size = group.column == "m"
    cells = table.cells(["row"])
    columns = table.columns()
    costs = _costs(table)
    published = _published(table) if is_by_size else {}
    rows: list[list] = []
    below: list[str] = []
    for row in table.rows():
        line = [row, *cells.loc[row, columns]]
        theirs = _paper_cells(published, _sampler_of(table, row), columns)
        if costs:
            line.append(costs.get(row, ""))
        rows.append(line)
        if theirs:
            if costs:
                theirs.append("")
            rows.append([PAPER, *theirs])
            below = [published["note"]] if "note" in published else []
    head = ["sampled by", *(f"{group.column}={column}" for column in columns)]
    if costs:
        head.append(collect.training_time(group.records)[0])
    title = f"Test {table.metric.title}: {table.subject}"
    if is_by_size:
        below += _full_lines(table)
    else:
        rows.append(["all points", *_full_cells(table, columns)])
        title += f", m={table.sizes},"
    title += f" under {table.net}; {_sets(table)}"
    if not is_by_size and len(columns) > MAX_COLUMNS:
        head, rows = _turned(group.column, columns, rows)
    return Grid(title, head, rows, below)


def _turned(
    setting: str, columns: Sequence[Any], rows: Sequence[Sequence[Any]]
) -> tuple[list[str], list[list]]:
    """Return the head and the rows of a table whose columns become rows.

    Args:
        setting: whose values give the columns.
        columns: its values.
        rows: a label each, and a cell for each value.
    """
    labels = [row[0] for row in rows]
    turned: list[list] = []
    for place, column in enumerate(columns, 1):
        cells = [row[place] for row in rows]
        turned.append([str(column), *cells])
    return [setting, *labels], turned


def _sampler_of(table: Table, row: str) -> str:
    """Return the name of a row's sampler in the paper's tables, whose net is the table's."""
    for record in table.group.records:
        names = collect.names(record)
        if table.row_names.of(record) == row and names["net"] == table.net:
            return names["sampler"]
    return row.partition(" from ")[0]  # a baseline, or a row of another net


def _paper_cells(published: dict[str, Any], sampler: str, columns: list[Any]) -> list[str]:
    """Return the paper's values of a sampler by size; empty if it has none of them."""
    by_size = published.get("rows", {}).get(sampler, {})
    cells = []
    for column in columns:
        values = by_size.get(str(column), [])
        cells.append(" / ".join(f"{value:.2f}" for value in values))
    return cells if any(cells) else []


def _full_cells(table: Table, columns: list[Any]) -> list[str]:
    """Return the values of full clouds by column."""
    full = table.full[table.full["metric"] == table.metric.name]
    by_column = full.groupby("column")["value"].last()
    texts = by_column.map(table.metric.format).to_dict()
    return [texts.get(column, "") for column in columns]


def _by_net(table: Table) -> Grid:
    """Return the scores of the same samples under several nets: size and sampler by net."""
    cells = table.cells(["m", "row"])
    columns = sorted(cells.columns, key=_net_key)
    places = sorted(cells.index, key=_place_key)
    rows: list[list] = []
    for m, row in places:
        rows.append([str(m), row, *cells.loc[(m, row), columns]])
    metric = table.full_metric
    label = "all points"
    if table.metric.full_cloud_metric:
        label += f" ({metric.title})"
    full = table.full[table.full["metric"] == metric.name]
    # Figures differ by seed where data depend on it; equal ones are of the same data.
    tested = full.drop_duplicates(["net", "value"]).groupby("net")["value"]
    means = tested.mean().map(metric.format).to_dict()
    rows.append(["", label, *(means.get(net, "") for net in columns)])
    title = (
        f"Test {table.metric.title} of the same samples under several task nets: "
        f"{table.subject}; {_sets(table)}"
    )
    return Grid(title, ["m", "sampled by", *columns], rows)


def _net_key(label: str) -> tuple[bool, str]:
    """Return a key that sorts nets by name, the net of the samplers' training first."""
    is_other = "of the training" not in label
    return is_other, label


def _place_key(place: tuple[int, str]) -> Any:
    """Return a key that sorts sizes and rows, the largest size first."""
    m, row = place
    return -m, sort_key(row)


def _plane(table: Table, row: str) -> Grid:
    """Return the grid of a sampler: rows are one setting's values, columns the other's.

    Below it is the range of its values by readout, a measure of sensitivity.
    """
    down, across = (key.rpartition(".")[2] for key in table.planes[row])
    of_row = table.cells(["row", "down"]).loc[row]
    in_order = of_row.sort_index().sort_index(axis=1)
    is_used = (in_order != "").any()
    cells = in_order.loc[:, is_used]
    lines: list[list] = []
    for left, line in zip(cells.index, cells.to_numpy(), strict=True):
        lines.append([f"{left:g}", *line])
    spreads = [_spread(table, row, readout) for readout in table.readouts(row)]
    readouts = " / ".join(table.readouts(row))
    title = (
        f"Test {table.metric.title} of {row}: {table.subject}, m={table.sizes}, "
        f"under {table.net}; {readouts} sets."
    )
    head = [f"{down} \\ {across}", *(f"{value:g}" for value in cells.columns)]
    return Grid(title, head, lines, [f"Spread over the plane of {row}: {', '.join(spreads)}."])


def _spread(table: Table, row: str, readout: str) -> str:
    """Return the range of a plane's values as text."""
    means = table.of(row, readout)["mean"]
    low = means.min()
    high = means.max()
    shown = table.metric.format
    text = f"{readout} {shown(low)} to {shown(high)}"
    if low > 0:
        text += f" (factor {high / low:.3g})"
    return text


def _costs(table: Table) -> dict[str, str]:
    """Return the seconds of training of every row by size: of all its trainings, for one seed."""
    if table.group.column != "m":
        return {}
    records = table.group.records
    runs = pd.DataFrame(
        {
            "row": [table.row_names.of(record) for record in records],
            "m": [_trained_size(record) for record in records],
            "seconds": collect.training_time(records)[1],
        }
    )
    of_trainings = runs.dropna().groupby(["row", "m"])["seconds"].mean()
    costs = of_trainings.groupby("row").sum()
    return costs.map("{:,.0f} s".format).to_dict()


def _trained_size(record: RunRecord) -> int:
    """Return the largest size that a record's sampler was trained for."""
    return record.config["sampler"].get("m_max", record.config["m"])


def _full_lines(table: Table) -> list[str]:
    """Return a line for each task net with its value on full clouds."""
    metric = table.full_metric
    published = _published(table, full_clouds=True)
    lines = []
    for record in sorted(table.group.records, key=_by_row_and_size):
        figure = record.metrics.get(f"test/{FULL}/{metric.name}")
        if figure is None:
            continue
        net = collect.names(record)["net"]
        text = metric.format(figure)
        if table.metric.full_cloud_metric:
            text = f"{metric.title} {text}"
        if net == table.net and "full" in published:
            text += f" (the paper: {published['full']:.2f})"
        lines.append(f"{net} on all points{_after_joint(record)}: {text}.")
    return list(dict.fromkeys(lines))


def _by_row_and_size(record: RunRecord) -> tuple[str, int]:
    return collect.sampler_row(record), -record.config["m"]


def _after_joint(record: RunRecord) -> str:
    """Return the sampler that a net was trained with, as a part of a sentence; empty if alone."""
    if collect.trained_with(record) != "joint":
        return ""
    text = f" after joint training with {collect.sampler_row(record)}"
    if not _has_several_sizes(record):
        text += f", m={record.config['m']}"
    return text


def _has_several_sizes(record: RunRecord) -> bool:
    """Return whether a run tested its sampler at several sizes."""
    for key in record.metrics:
        name = parse_metric_name(key)
        if name is not None and name.m is not None:
            return True
    return False


def _published(table: Table, full_clouds: bool = False) -> dict[str, Any]:
    """Return the paper's table; empty if it has none, and for test clouds that were changed."""
    records = table.group.records
    if any(_changes_test_clouds(record) for record in records):
        return {}
    metric = table.full_metric if full_clouds else table.metric
    is_joint = collect.trained_with(records[0]) == "joint"
    names = table.names
    return paper.published(names["task"], table.net, names["dataset"], metric.name, is_joint)


def _changes_test_clouds(record: RunRecord) -> bool:
    return any(record.config.get(key) for key in OF_TEST_CLOUDS)
