"""How a run ends on the screen: one table and one line."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mops_lightning.records import metric_format
from mops_lightning.records.readout_names import FULL, ROWS, parse
from mops_lightning.records.run_record import FILE, summary_metrics

Rows = dict[str, dict[str, float | None]]
"""Readout → metric, or m=SIZE where several are tested → value."""


def readout_rows(metrics: dict[str, float | None], score: str | None = None) -> Rows:
    """Group a record's flat test metrics by readout.

    Args:
        metrics: such as ``{"test/generated/accuracy": 0.8}``.
        score: the metric to show where several sizes are tested; None: the only one.

    Returns:
        ``{"generated": {"accuracy": 0.8}}``, or ``{"generated": {"m=32": 0.8}}`` where several
        sizes are tested: baselines first, full clouds last, which count for every size.
    """
    parts = {name: parse(name) for name in metrics}
    several = any(part and part.m for part in parts.values())
    rows: Rows = {}
    for name, part in parts.items():
        if part is None or (several and score not in (None, part.metric)):
            continue
        column = part.metric if not several else f"m={part.m}" if part.m else FULL
        rows.setdefault(part.readout, {})[column] = metrics[name]
    order = {name: position for position, name in enumerate(ROWS)}
    return dict(sorted(rows.items(), key=lambda item: order.get(item[0], -1)))


def closing_lines(folder: Path, record: dict[str, Any], console: Console | None = None) -> None:
    """Print the table of test results and where everything lies.

    Args:
        folder: the run's folder.
        record: the run's record.
        console: where to print; the standard output by default.
    """
    console = console or Console()
    title, table = results_table(record)
    console.print(title, soft_wrap=True, highlight=False, style="italic")
    console.print(table)
    files = ", ".join([FILE, *sorted(record["files"].values())])
    seconds = record["seconds"]["total"]
    console.print(
        f"{record['status']} in {seconds:.0f} s; in {folder}/ lie {files}",
        soft_wrap=True,
        highlight=False,
    )


def results_table(record: dict[str, Any]) -> tuple[str, Table]:
    """Return a title and what every readout scored: by metric, or by size if there are several."""
    config = record["config"]
    names, score = config["names"], parse(record["notes"].get("score", ""))
    several = score.metric if score and score.m else None
    rows = readout_rows(record["metrics"], several)
    # The task's own scores; figures of the sampled set stay in the record.
    columns = list(rows.get(FULL, {}))
    columns = [name for name in summary_metrics(record) if name in columns] or columns
    what = "all points" if config.get("learn") == "task" else f"m={config['m']}"
    if several:
        columns = list(next(iter(rows.values())))
        rows[FULL] = dict.fromkeys(columns, next(iter(rows[FULL].values())))
        what = metric_format.title(several)
    table = Table()
    table.add_column("sampled by")
    for column in columns:
        table.add_column(column if several else metric_format.title(column), justify="right")
    for readout, row in rows.items():
        values = [row.get(column) for column in columns]
        if all(value is None for value in values):
            continue  # figures of the set alone
        label = f"{names['sampler']} {readout}" if readout in ROWS[:-1] else readout
        cells = [
            "" if value is None else metric_format.figure(several or column, value)
            for column, value in zip(columns, values, strict=True)
        ]
        table.add_row("all points" if readout == FULL else label, *cells)
    return f"{names['task']} by {names['net']}, {names['dataset']}, {what}, test", table
