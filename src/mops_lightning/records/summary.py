"""The end of a run's output: a table of its test results and the paths of its files."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mops_lightning.records.collapse import collapse_line, collapsed, distinct_points
from mops_lightning.records.metric_info import in_summary_order, metric_info
from mops_lightning.records.readout_names import FULL, ROWS, parse_metric_name
from mops_lightning.records.run_record import FILE, Names, RunRecord

OWN = "own"
"""Name of a group whose class the user names on the command line."""

OF_TEST_CLOUDS = ("test_noise_std", "test_corruption")
"""Settings that change the test clouds; in reports, their values give the columns of a table."""


def closing_lines(folder: Path, record: RunRecord, console: Console | None = None) -> None:
    """Print the table of test results and the output paths.

    Args:
        folder: the run's folder.
        record: the run's record.
        console: where to print; standard output by default.
    """
    console = console or Console()
    if record.metrics:  # trainer.limit_test_batches=0 tests nothing
        title, table = results_table(record)
        console.print(title, soft_wrap=True, highlight=False, style="italic")
        console.print(table)
        if line := collapse_line(record):
            console.print(line, soft_wrap=True, highlight=False)
    files = ", ".join([FILE, *sorted(record.files.values())])
    seconds = record.seconds["total"]
    partial = f", but {' and '.join(record.partial)}" if record.partial else ""
    console.print(
        f"{record.status} in {seconds:.0f} s{partial}; files in {folder}/: {files}",
        soft_wrap=True,
        highlight=False,
    )


def results_table(record: RunRecord) -> tuple[str, Table]:
    """Return a title and the test results of every readout, by metric or by size.

    Baselines come first, full clouds last; the latter hold for every size.
    """
    config = record.config
    names = shown_names(config)
    score = parse_metric_name(record.score_name)
    by_size = score.metric if score and score.m else None
    rows: dict[str, dict[str, float | None]] = {}
    for name, value in record.metrics.items():
        parts = parse_metric_name(name)
        if parts and by_size in (None, parts.metric):
            column = f"m={parts.m}" if by_size else parts.metric
            rows.setdefault(parts.readout, {})[column] = value
    rows = dict(sorted(rows.items(), key=lambda row: ROWS.index(row[0]) if row[0] in ROWS else -1))
    if by_size:
        info = metric_info(by_size, [record])
        columns = {size: (size, info) for size in next(iter(rows.values()))}
        rows[FULL] = dict.fromkeys(columns, next(iter(rows[FULL].values())))
        what = info.title
    else:
        # Metrics of the task only: a full cloud has no metrics of the sampled set.
        infos = in_summary_order(metric_info(name, [record]) for name in rows.get(FULL, {}))
        columns = {info.name: (info.title, info) for info in infos}
        what = "all points" if config.get("learn") == "task" else f"m={config['m']}"
    table = Table()
    table.add_column("sampled by")
    for head, _ in columns.values():
        table.add_column(head, justify="right")
    found = collapsed(record)
    if found and not by_size:
        table.add_column("distinct points", justify="right")
    for readout, row in rows.items():
        cells = [
            "" if (value := row.get(column)) is None else info.format(value)
            for column, (_, info) in columns.items()
        ]
        if not any(cells):  # it has metrics of the sampled set only
            continue
        if found and not by_size and readout in ("generated", "matched"):
            cells.append(f"{found[config['m']]:.1f}")
        table.add_row(_label(readout, config), *cells)
    if found and by_size:
        distinct = distinct_points(record)
        counts = [f"{distinct[m]:.1f}" for m in (int(column[2:]) for column in columns)]
        table.add_row("distinct points", *counts)
    title = f"{names['task']} by {names['net']}, {names['dataset']}, {what}, test"
    changed = [f"{name}={config[name]}" for name in OF_TEST_CLOUDS if config.get(name)]
    return ", ".join([title, *changed]), table


def shown_names(config: dict[str, Any]) -> Names:
    """Return the names of a run's groups for titles and rows.

    A group whose class the user named on the command line is shown by this class, so that two
    classes have two names.
    """
    task = config["task"]
    nodes = {
        "task": task,
        "net": task.get("net"),
        "dataset": config["dataset"],
        "sampler": config.get("sampler"),
    }
    names: Any = dict(config["names"])
    for group, node in nodes.items():
        target = (node or {}).get("_target_")
        if target and names[group] == OWN:
            names[group] = str(target).rpartition(".")[2]
    return names


def sampler_name(config: dict[str, Any]) -> str:
    """Return the name of a run's sampler, and for FPS the start point if it is set.

    A MOPS-Net with anchors is ``mops anchored``, FPS from the farthest point ``fps from farthest``.
    """
    sampler = config.get("sampler") or {}
    anchored = " anchored" if sampler.get("anchors") else ""
    return shown_names(config)["sampler"] + anchored + _start(sampler)


def baseline_name(config: dict[str, Any], name: str) -> str:
    """Return the name of a run's baseline, and for FPS the start point if it is set.

    Two baselines need two names: ``fps`` and ``fps_farthest``, which is ``fps from farthest``.
    """
    node = (config.get("baselines") or {}).get(name) or {}
    return name.removesuffix(f"_{node.get('start')}") + _start(node)


def _start(sampler: dict[str, Any]) -> str:
    start = sampler.get("start")
    return "" if start is None else f" from {start if isinstance(start, str) else f'row {start}'}"


def _label(readout: str, config: dict[str, Any]) -> str:
    """Return the label of a readout's row."""
    if readout == FULL:
        return "all points"
    own = f"{sampler_name(config)} {readout}"
    return own if readout in ROWS else baseline_name(config, readout)
