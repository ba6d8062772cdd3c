"""The end of a run's output: a table of its test results and the paths of its files."""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.collapse import collapse_line, collapsed, distinct_points
from mops_lightning.records.metric_info import in_summary_order, metric_info
from mops_lightning.records.readout_names import (
    COMPLETED,
    FULL,
    GENERATED,
    INDEX_READOUT,
    MATCHED,
    ROWS,
    parse_metric_name,
)
from mops_lightning.records.run_record import FILE, Names, RunRecord
from mops_lightning.records.verdict import verdict

OWN = "own"
"""Name of a group whose class the user names on the command line."""

DISTINCT = "distinct points"
"""Label of the numbers of distinct points of a sampler that has collapsed."""

JUDGED = (COMPLETED, INDEX_READOUT)
"""The readouts of input points, of which a sampler has one."""

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
        for line in (collapse_line(record), advice(record)):
            if line:
                console.print(line, soft_wrap=True, highlight=False)
    seconds = record.seconds["total"]
    status = f"{record.status} in {seconds:.0f} s"
    if record.partial:
        status += f", but {' and '.join(record.partial)}"
    files = ", ".join([FILE, *sorted(record.files.values())])
    line = f"{status}; files in {folder}/: {files}"
    console.print(line, soft_wrap=True, highlight=False)


def advice(record: RunRecord) -> str:
    """Return which method to use for how many points, of runs on own files and of registration.

    The sampler's completed sets, or the input points that it chose, are compared with the baselines
    by the task's score; empty for other runs.
    """
    names = record.config["names"]
    score = parse_metric_name(record.score_name)
    is_asked = names["dataset"] == "clouds" or names["task"] == "registration"
    if not is_asked or score is None:
        return ""
    scores: dict[int, dict[str, list[float]]] = defaultdict(dict)
    for key, value in record.metrics.items():
        name = parse_metric_name(key)
        if name is None or name.metric != score.metric or value is None:
            continue
        is_baseline = name.readout not in ROWS
        if is_baseline or name.readout in JUDGED:
            m = name.m or record.config["m"]
            scores[m][name.readout] = [value]
    own = [readout for readout in JUDGED if all(readout in values for values in scores.values())]
    if not own:
        return ""
    info = metric_info(score.metric, [record])
    return verdict(scores, info, own)


@dataclass(frozen=True)
class _Results:
    """The content of the closing table.

    Attributes:
        what: for the title: what its values are, or of how many points.
        columns: the metric of every column, by the name of a metric or by size.
        rows: value by column, by readout.
        by_size: whether columns are sizes.
    """

    what: str
    columns: dict[Any, MetricInfo]
    rows: dict[str, dict[Any, float | None]]
    by_size: bool

    def titles(self) -> list[str]:
        """Return the titles of the columns."""
        if self.by_size:
            return [f"m={size}" for size in self.columns]
        return [metric.title for metric in self.columns.values()]

    def cells(self, readout: str) -> list[str]:
        """Return the values of a readout as texts, empty for those that it does not have."""
        texts = []
        for column, metric in self.columns.items():
            value = self.rows[readout].get(column)
            text = ""
            if value is not None:
                text = metric.format(value)
            texts.append(text)
        return texts


def results_table(record: RunRecord) -> tuple[str, Table]:
    """Return a title and the test results of every readout, by metric or by size.

    Baselines come first, full clouds last; the latter hold for every size.
    """
    config = record.config
    score = parse_metric_name(record.score_name)
    if score is not None and score.m is not None:
        results = _by_size(record, score.metric)
    else:
        results = _by_metric(record)
    has_collapsed = bool(collapsed(record))
    own_column = has_collapsed and not results.by_size
    table = Table()
    table.add_column("sampled by")
    for title in results.titles():
        table.add_column(title, justify="right")
    if own_column:
        table.add_column(DISTINCT, justify="right")
    for readout in sorted(results.rows, key=_row_key):
        cells = results.cells(readout)
        if not any(cells):  # it has metrics of the sampled set only
            continue
        if own_column and readout in (GENERATED, MATCHED):
            count = collapsed(record)[config["m"]]
            cells.append(f"{count:.1f}")
        table.add_row(_label(readout, config), *cells)
    if has_collapsed and results.by_size:
        counts = distinct_points(record)
        cells = [f"{counts[size]:.1f}" for size in results.columns]
        table.add_row(DISTINCT, *cells)
    names = shown_names(config)
    task = f"{names['task']} by {names['net']}"
    parts = [task, names["dataset"], results.what, "test"]
    for name in OF_TEST_CLOUDS:
        if config.get(name):
            parts.append(f"{name}={config[name]}")
    return ", ".join(parts), table


def _by_size(record: RunRecord, metric: str) -> _Results:
    """Return the values of a metric at every size."""
    info = metric_info(metric, [record])
    rows: dict[str, dict[Any, float | None]] = {}
    full = None
    for key, value in record.metrics.items():
        name = parse_metric_name(key)
        if name is None or name.metric != metric:
            continue
        if name.readout == FULL:
            full = value
        else:
            rows.setdefault(name.readout, {})[name.m] = value
    first = min(rows, key=_row_key)
    columns = dict.fromkeys(rows[first], info)
    rows[FULL] = dict.fromkeys(columns, full)
    return _Results(info.title, columns, rows, by_size=True)


def _by_metric(record: RunRecord) -> _Results:
    """Return the values of all metrics of the task."""
    rows: dict[str, dict[Any, float | None]] = {}
    for key, value in record.metrics.items():
        name = parse_metric_name(key)
        if name is not None:
            rows.setdefault(name.readout, {})[name.metric] = value
    # Metrics of the task only: a full cloud has no metrics of the sampled set.
    metrics = [metric_info(name, [record]) for name in rows.get(FULL, {})]
    columns = {info.name: info for info in in_summary_order(metrics)}
    what = f"m={record.config['m']}"
    is_task_alone = record.config.get("learn") == "task"
    if is_task_alone:
        what = "all points"
    return _Results(what, columns, rows, by_size=False)


def _row_key(readout: str) -> int:
    """Return a key that sorts readouts as tables do, baselines first."""
    if readout not in ROWS:
        return -1
    return ROWS.index(readout)


def shown_names(config: dict[str, Any]) -> Names:
    """Return the names of a run's groups for titles and rows.

    A group whose class the user named on the command line is shown by this class, so that two
    classes have two names.
    """
    nodes = {
        "task": config["task"],
        "net": config["task"].get("net"),
        "dataset": config["dataset"],
        "sampler": config.get("sampler"),
    }
    names: Any = dict(config["names"])
    for group, node in nodes.items():
        if node and names[group] == OWN and node.get("_target_"):
            target = str(node["_target_"])
            names[group] = target.rpartition(".")[2]
    return names


def sampler_name(config: dict[str, Any]) -> str:
    """Return the name of a run's sampler, and for FPS the start point if it is set.

    A MOPS-Net with anchors is ``mops anchored``, FPS from the farthest point ``fps from farthest``.
    """
    sampler = config.get("sampler") or {}
    name = shown_names(config)["sampler"]
    if sampler.get("anchors"):
        name += " anchored"
    return name + _start(sampler)


def baseline_name(config: dict[str, Any], name: str) -> str:
    """Return the name of a run's baseline, and for FPS the start point if it is set.

    Two baselines need two names: ``fps`` and ``fps_farthest``, which is ``fps from farthest``.
    """
    baselines = config.get("baselines") or {}
    node = baselines.get(name) or {}
    suffix = f"_{node.get('start')}"
    return name.removesuffix(suffix) + _start(node)


def _start(sampler: dict[str, Any]) -> str:
    """Return the start point of FPS as the end of a name; empty if it is not set."""
    start = sampler.get("start")
    if start is None:
        return ""
    if isinstance(start, str):
        return f" from {start}"
    return f" from row {start}"


def _label(readout: str, config: dict[str, Any]) -> str:
    """Return the label of a readout's row."""
    if readout == FULL:
        return "all points"
    if readout in ROWS:
        return f"{sampler_name(config)} {readout}"
    return baseline_name(config, readout)
