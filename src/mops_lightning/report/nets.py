"""A table of task nets: what they score on all points, and how large they are."""

from collections.abc import Sequence
from typing import Any

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.metric_info import in_summary_order, metric_info
from mops_lightning.records.readout_names import FULL
from mops_lightning.report import paper
from mops_lightning.report.axes import varying
from mops_lightning.report.cells import over_seeds
from mops_lightning.report.collect import Record, one_commit, same_for_every_seed, score, seed
from mops_lightning.report.text import PAPER, Grid

HIDDEN = ("_target_", "n_points")
"""Settings of a net that its table does not list; the number of points has a column of its own."""


def nets_grid(found: list[Record], metrics: Sequence[str] = (), mixed: bool = False) -> Grid:
    """Return a table with a row for each net, by number of points and settings.

    Sizes are of float32 parameters, in MB of a million bytes. Where the paper compares the same
    nets, its figures stand in the last column. Several seeds make means and deviations.

    Args:
        found: completed records of runs with ``learn=task``.
        metrics: what is shown; none: what the task shows.
        mixed: whether different commits and settings of the training are allowed.

    Raises:
        UserError: the records are of different tasks, data, commits or settings, or two are of
            one net and seed; or no record has a metric.
    """
    for what in ("task", "dataset"):
        names = sorted({record["config"]["names"][what] for record in found})
        if len(names) > 1:
            raise UserError(
                f"The runs differ in {what}: {', '.join(names)}. Their figures do not belong in "
                "one table; give a folder with runs of one kind."
            )
    one_commit(found, mixed)
    for points in {_points(record) for record in found}:
        same = [record for record in found if _points(record) == points]
        same_for_every_seed("data (dataset_fingerprint)", "dataset_fingerprint", same)
    different = [key for key in varying(found) if not key.startswith(("task.net.", "sampler."))]
    if different and not mixed:
        raise UserError(
            f"The runs differ in their settings ({', '.join(different)}). If their figures may "
            "stand in one table all the same, add --mixed."
        )
    names = found[0]["config"]["names"]
    nets = [_net(record) for record in found]
    keys = sorted({key for net in nets for key in net} - set(HIDDEN))
    keys = [key for key in keys if len({str(net[key]) for net in nets if key in net}) > 1]
    shown = _metrics(found, metrics)
    groups: dict[tuple[Any, ...], dict[int, Record]] = {}
    for record in found:
        label = [(_net(record).get(key) is not None, _net(record).get(key) or 0) for key in keys]
        place = (_points(record) or 0, *label, record["config"]["names"]["net"])
        if seed(record) in groups.setdefault(place, {}):
            raise UserError(
                f"Two runs of {names['task']} by the same net and seed are there, the second one "
                f"in {record['folder']}; give a folder with one of each."
            )
        groups[place][seed(record)] = record
    rows = [_row(list(groups[place].values()), keys, shown) for place in sorted(groups)]
    head = ["net", *keys, "points", *(info.title for info in shown), "MB", PAPER]
    if not any(row[-1] for row in rows):
        head, rows = head[:-1], [row[:-1] for row in rows]
    title = f"No sampler was tested; {names['task']} on {names['dataset']} from all points."
    return Grid(title, head, rows)


def _row(records: list[Record], keys: list[str], metrics: list[MetricInfo]) -> list[str]:
    """Return the cells of one net, over all its seeds."""
    first = records[0]
    label = [first["config"]["names"]["net"], *map(_net(first).get, keys), _points(first)]
    figures = []
    for metric in metrics:
        values = [record["metrics"].get(f"test/{FULL}/{metric.name}") for record in records]
        there = [value for value in values if value is not None]
        count = f" (n={len(there)})" if len(there) > 1 else ""
        figures.append(over_seeds(metric, there) + count if there else "")
    size = first["notes"].get("parameters", {}).get("task")
    megabytes = "" if size is None else f"{4e-6 * size:.1f}"
    texts = ["" if value is None else str(value) for value in label]
    return [*texts, *figures, megabytes, _paper(first)]


def _net(record: Record) -> dict[str, Any]:
    return record["config"]["task"].get("net") or {}


def _points(record: Record) -> int | None:
    return record["config"].get("dataset", {}).get("n_points")


def _metrics(found: list[Record], asked: Sequence[str]) -> list[MetricInfo]:
    """Return the metrics of full clouds: those asked for, or those in the closing table."""
    names = {name for record in found for name in record["metrics"]}
    there = {name.rsplit("/", 1)[1] for name in names if name.startswith(f"test/{FULL}/")}
    for name in asked:
        if name not in there:
            raise UserError(f"--metric: no run has {name!r}.{did_you_mean(name, there)}")
    if asked:
        return [metric_info(name, found) for name in asked]
    infos = in_summary_order(metric_info(name, found) for name in there)
    return [info for info in infos if info.full_cloud_metric is None]  # the rest is 1 here


def _paper(record: Record) -> str:
    config = record["config"]
    task, net = config["names"]["task"], config["names"]["net"]
    figures = (
        paper.net(net, _net(record).get("pieces"), _points(record))
        if task == "reconstruction"
        else None
    )
    if figures:
        return " / ".join(f"{value:g}" for value in figures)
    published = paper.table(task, config["names"]["dataset"], score([record])).get("full")
    return "" if published is None else f"{published:.2f}"
