"""A table of task nets: their results on full clouds, and their sizes."""

from collections.abc import Sequence
from typing import Any

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.metric_info import in_summary_order, metric_info
from mops_lightning.records.readout_names import FULL
from mops_lightning.records.run_record import RunRecord
from mops_lightning.report import paper
from mops_lightning.report.axes import varying
from mops_lightning.report.cells import over_seeds
from mops_lightning.report.collect import score, seed
from mops_lightning.report.comparable import require_one, require_one_commit, same_for_every_seed
from mops_lightning.report.text import PAPER, Grid

HIDDEN = ("_target_", "n_points")
"""Settings of a net that get no column; the number of points has its own."""


def nets_grid(found: list[RunRecord], metrics: Sequence[str] = (), mixed: bool = False) -> Grid:
    """Return a table with a row for each net, sorted by number of points and settings.

    Sizes are of float32 parameters, in MB of a million bytes. Values of several seeds are means ±
    standard deviations. The last column has the paper's values for the same net, if there are any.

    Args:
        found: completed records of runs with ``learn=task``.
        metrics: names of the metrics to show; none: those of the closing table.
        mixed: whether different commits and settings of the training are allowed.

    Raises:
        UserError: the runs are not comparable, two have the same net and seed, or no record has a
            metric.
    """
    _require_comparable(found, mixed)
    names = found[0].config["names"]
    nets = [_net(record) for record in found]
    keys = sorted({key for net in nets for key in net} - set(HIDDEN))
    keys = [key for key in keys if len({str(net[key]) for net in nets if key in net}) > 1]
    infos = _metrics(found, metrics)
    groups = _by_net(found, keys)
    rows = [_row(list(groups[place].values()), keys, infos) for place in sorted(groups)]
    head = ["net", *keys, "points", *(info.title for info in infos), "MB", PAPER]
    if not any(row[-1] for row in rows):
        head, rows = head[:-1], [row[:-1] for row in rows]
    title = f"No sampler was tested; {names['task']} on {names['dataset']} from all points."
    return Grid(title, head, rows)


def _require_comparable(found: list[RunRecord], mixed: bool) -> None:
    for what in ("task", "dataset"):
        require_one(what, {record.config["names"][what] for record in found})
    require_one_commit(found, mixed)
    for points in {_points(record) for record in found}:
        same = [record for record in found if _points(record) == points]
        same_for_every_seed("data (dataset_fingerprint)", "dataset_fingerprint", same)
    different = [key for key in varying(found) if not key.startswith(("task.net.", "sampler."))]
    if different and not mixed:
        raise UserError(
            f"The runs differ in their settings ({', '.join(different)}). Add --mixed to show them "
            "in one table."
        )


def _by_net(found: list[RunRecord], keys: list[str]) -> dict[tuple[Any, ...], dict[int, RunRecord]]:
    """Return sort key of a net → seed → record."""
    groups: dict[tuple[Any, ...], dict[int, RunRecord]] = {}
    for record in found:
        net, names = _net(record), record.config["names"]
        label = [(net.get(key) is not None, net.get(key) or 0) for key in keys]
        place = (_points(record) or 0, *label, names["net"])
        if seed(record) in groups.setdefault(place, {}):
            raise UserError(
                f"Two runs of {names['task']} have the same net and seed; the second is "
                f"{record.folder}. Give a folder with one of each."
            )
        groups[place][seed(record)] = record
    return groups


def _row(records: list[RunRecord], keys: list[str], metrics: list[MetricInfo]) -> list[str]:
    """Return the cells of one net, over all its seeds."""
    first = records[0]
    label = [first.config["names"]["net"], *map(_net(first).get, keys), _points(first)]
    texts = ["" if value is None else str(value) for value in label]
    for metric in metrics:
        values = [record.metrics.get(f"test/{FULL}/{metric.name}") for record in records]
        present = [value for value in values if value is not None]
        count = f" (n={len(present)})" if len(present) > 1 else ""
        texts.append(over_seeds(metric, present) + count if present else "")
    size = first.parameters.get("task")
    return [*texts, "" if size is None else f"{4e-6 * size:.1f}", _paper(first)]


def _net(record: RunRecord) -> dict[str, Any]:
    return record.config["task"].get("net") or {}


def _points(record: RunRecord) -> int | None:
    return record.config.get("dataset", {}).get("n_points")


def _metrics(found: list[RunRecord], requested: Sequence[str]) -> list[MetricInfo]:
    """Return the metrics of full clouds: those requested, or those of the closing table."""
    names = {name for record in found for name in record.metrics}
    known = {name.rsplit("/", 1)[1] for name in names if name.startswith(f"test/{FULL}/")}
    for name in requested:
        if name not in known:
            raise UserError(f"--metric: no run has {name!r}.{did_you_mean(name, known)}")
    if requested:
        return [metric_info(name, found) for name in requested]
    infos = in_summary_order(metric_info(name, found) for name in known)
    return [info for info in infos if info.full_cloud_metric is None]  # the rest is 1 here


def _paper(record: RunRecord) -> str:
    names, points = record.config["names"], _points(record)
    values = None
    if names["task"] == "reconstruction":
        values = paper.net(names["net"], _net(record).get("pieces"), points)
    if values:
        return " / ".join(f"{value:g}" for value in values)
    published = paper.table(names["task"], names["dataset"], score([record])).get("full")
    return "" if published is None else f"{published:.2f}"
