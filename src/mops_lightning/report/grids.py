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
        rows = sorted(table.planes, key=sort_key)
        texts = [_plane(table, row) for row in rows]
        texts[-1].below += _full_lines(table)
    elif table.group.column == "net":
        texts = [_by_net(table)]
    else:
        texts = [_by_column(table)]
    texts[-1].below += _level_line(table)
    texts[-1].below += _unchanged_lines(table)
    is_dirty = table.values["dirty"].any()
    texts[-1].below += dirty_line(is_dirty)
    if table.group.about:
        for grid in texts:
            grid.title += f" ({table.group.about})"
    return texts


def _level_line(table: Table) -> list[str]:
    """Return a line that says what bold means, if a value is bold and not the best."""
    if not table.values["level"].any():
        return []
    return [
        "Bold: the best value, and those level with it: less than two standard deviations over "
        "seeds away, or better than such a value."
    ]


def _unchanged_lines(table: Table) -> list[str]:
    """Return a line for each sampler whose cells are equal, though its settings differ."""
    if not table.group.settings:
        return []
    lines = []
    for row in table.rows():
        values = table.values[table.values["row"] == row]
        texts = values["mean"].map(table.metric.format)
        of_readouts = texts.groupby(values["readout"])
        different = of_readouts.nunique().max()
        if different == 1 and of_readouts.count().min() > 1:
            lines.append(
                f"All {of_readouts.count().max()} cells of {row} are equal: the settings that "
                "differ changed no figure."
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
    published = {}
    if is_by_size:
        published = _published(table)
    rows: list[list] = []
    below: list[str] = []
    for row in table.rows():
        line = [row, *cells.loc[row, columns]]
        sampler = _sampler_of(table, row)
        theirs = _paper_cells(published, sampler, columns)
        if costs:
            line.append(costs.get(row, ""))
        rows.append(line)
        if theirs:
            if costs:
                theirs.append("")
            rows.append([PAPER, *theirs])
            below = []
            if "note" in published:
                below.append(published["note"])
    head = ["sampled by"]
    head += [f"{group.column}={column}" for column in columns]
    if costs:
        name_of_costs, _ = collect.training_time(group.records)
        head.append(name_of_costs)
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
        is_of_row = table.row_names.of(record) == row
        if is_of_row and names["net"] == table.net:
            return names["sampler"]
    return row.partition(" from ")[0]  # a baseline, or a row of another net


def _paper_cells(published: dict[str, Any], sampler: str, columns: list[Any]) -> list[str]:
    """Return the paper's values of a sampler by size; empty if it has none of them."""
    rows = published.get("rows", {})
    by_size = rows.get(sampler, {})
    cells = []
    for column in columns:
        values = [f"{value:.2f}" for value in by_size.get(str(column), [])]
        cells.append(" / ".join(values))
    if not any(cells):
        return []
    return cells


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
        line = cells.loc[(m, row), columns]
        rows.append([str(m), row, *line])
    metric = table.full_metric
    label = "all points"
    if table.metric.full_cloud_metric:
        label += f" ({metric.title})"
    full = table.full[table.full["metric"] == metric.name]
    # Figures differ by seed where data depend on it; equal ones are of the same data.
    different = full.drop_duplicates(["net", "value"])
    means = different.groupby("net")["value"].mean()
    texts = means.map(metric.format).to_dict()
    rows.append(["", label, *[texts.get(net, "") for net in columns]])
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
    down, across = (_last_name(key) for key in table.planes[row])
    of_row = table.cells(["row", "down"]).loc[row]
    in_order = of_row.sort_index().sort_index(axis=1)
    is_used = (in_order != "").any()
    cells = in_order.loc[:, is_used]
    lines: list[list] = []
    for left, line in zip(cells.index, cells.to_numpy(), strict=True):
        lines.append([f"{left:g}", *line])
    readouts = table.readouts(row)
    title = (
        f"Test {table.metric.title} of {row}: {table.subject}, m={table.sizes}, "
        f"under {table.net}; {' / '.join(readouts)} sets."
    )
    head = [f"{down} \\ {across}"]
    head += [f"{value:g}" for value in cells.columns]
    spreads = ", ".join(_spread(table, row, readout) for readout in readouts)
    return Grid(title, head, lines, [f"Spread over the plane of {row}: {spreads}."])


def _last_name(setting: str) -> str:
    return setting.rpartition(".")[2]


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
    _, seconds = collect.training_time(records)
    runs = pd.DataFrame(
        {
            "row": [table.row_names.of(record) for record in records],
            "m": [_trained_size(record) for record in records],
            "seconds": seconds,
        }
    )
    trainings = runs.dropna().groupby(["row", "m"])
    of_trainings = trainings["seconds"].mean()
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
        key = f"test/{FULL}/{metric.name}"
        figure = record.metrics.get(key)
        if figure is None:
            continue
        net = collect.names(record)["net"]
        text = metric.format(figure)
        if table.metric.full_cloud_metric:
            text = f"{metric.title} {text}"
        if net == table.net and "full" in published:
            text += f" (the paper: {published['full']:.2f})"
        after = _after_joint(table, record)
        lines.append(f"{net} on all points{after}: {text}.")
    return list(dict.fromkeys(lines))


def _by_row_and_size(record: RunRecord) -> tuple[str, int]:
    return collect.sampler_row(record), -record.config["m"]


def _after_joint(table: Table, record: RunRecord) -> str:
    """Return the row that a net was trained with, as a part of a sentence; empty if alone."""
    if collect.trained_with(record) != "joint":
        return ""
    row = table.row_names.of(record).rpartition(" on ")[2]  # the net is named already
    text = f" after joint training with {row}"
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
    metric = table.metric
    if full_clouds:
        metric = table.full_metric
    is_joint = collect.trained_with(records[0]) == "joint"
    task = table.names["task"]
    dataset = table.names["dataset"]
    return paper.published(task, table.net, dataset, metric.name, is_joint)


def _changes_test_clouds(record: RunRecord) -> bool:
    return any(record.config.get(key) for key in OF_TEST_CLOUDS)
