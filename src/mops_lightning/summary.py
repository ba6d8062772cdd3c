"""How a run ends on the screen: one table and one line."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mops_lightning.records import FILE

LAST = ("generated", "matched", "completed", "sampled", "full")
"""Readouts in the order of the table, after the baselines."""


def readout_rows(metrics: dict[str, float | None], prefix: str = "test/") -> dict[str, dict]:
    """Group a record's flat test metrics by readout.

    Args:
        metrics: such as ``{"test/generated/accuracy": 0.8}``.
        prefix: what the names start with.

    Returns:
        ``{"generated": {"accuracy": 0.8}}``: baselines first, full clouds last.
    """
    rows: dict[str, dict] = {}
    for name, value in metrics.items():
        parts = name.removeprefix(prefix).split("/")
        if name.startswith(prefix) and len(parts) == 2 and parts[0] not in ("loss", "matrix"):
            rows.setdefault(parts[0], {})[parts[1]] = value
    order = {name: position for position, name in enumerate(LAST)}
    return dict(sorted(rows.items(), key=lambda item: order.get(item[0], -1)))


def closing_lines(folder: Path, record: dict[str, Any], console: Console | None = None) -> None:
    """Print the table of test results and where everything lies.

    Args:
        folder: the run's folder.
        record: the run's record.
        console: where to print; the standard output by default.
    """
    console = console or Console()
    config = record["config"]
    names, rows = config["names"], readout_rows(record["metrics"])
    # The task's own scores; figures of the sampled set stay in the record.
    columns = list(rows.get("full", {}))
    title = f"{names['task']} by {names['net']}, {names['dataset']}, m={config['m']}, test"
    table = Table(title=title, title_justify="left")
    table.add_column("sampled by")
    for column in columns:
        table.add_column(column.replace("_", " "), justify="right")
    for readout, row in rows.items():
        label = f"{names['sampler']} {readout}" if readout in LAST[:4] else readout
        cells = ["" if row.get(c) is None else _number(c, row[c]) for c in columns]
        table.add_row("all points" if readout == "full" else label, *cells)
    console.print(table)
    files = ", ".join([FILE, *sorted(record["files"].values())])
    seconds = record["seconds"]["total"]
    console.print(
        f"{record['status']} in {seconds:.0f} s; in {folder}/ lie {files}",
        soft_wrap=True,
        highlight=False,
    )


def _number(name: str, value: float) -> str:
    return f"{100 * value:.2f} %" if "accuracy" in name else f"{value:.4g}"
