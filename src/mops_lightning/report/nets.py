"""A table of task nets: what they score on all points, and how large they are."""

from typing import Any

from mops_lightning import paper, units
from mops_lightning.errors import UserError
from mops_lightning.readout_names import FULL
from mops_lightning.report.text import PAPER, Grid

HIDDEN = ("_target_", "n_points")
"""Settings of a net that its table does not list; the number of points has a column of its own."""


def nets_grid(found: list[dict[str, Any]]) -> Grid:
    """Return a table with a row for each net, by number of points and settings.

    Sizes are of float32 parameters, in MB of a million bytes. Where the paper compares the same
    nets, its figures stand in the last column.

    Args:
        found: completed records of runs with ``learn=task``.

    Raises:
        UserError: the records are of different tasks or data, or two are of one net.
    """
    for what in ("task", "dataset"):
        names = sorted({record["config"]["names"][what] for record in found})
        if len(names) > 1:
            raise UserError(
                f"The runs differ in {what}: {', '.join(names)}. Their figures do not belong in "
                "one table; give a folder with runs of one kind."
            )
    names = found[0]["config"]["names"]
    nets = [record["config"]["task"].get("net") or {} for record in found]
    keys = sorted({key for net in nets for key in net} - set(HIDDEN))
    keys = [key for key in keys if len({str(net[key]) for net in nets if key in net}) > 1]
    metrics = _metrics(found)
    theirs = [_paper(record) for record in found]
    columns = ["net", *keys, "points", *map(units.title, metrics), "MB"]
    columns += [PAPER] if any(theirs) else []
    rows: dict[tuple[Any, ...], list[str]] = {}
    for record, net, published in zip(found, nets, theirs, strict=True):
        points = record["config"].get("dataset", {}).get("n_points")
        label = (record["config"]["names"]["net"], *(net.get(key) for key in keys), points)
        values = [record["metrics"].get(f"test/{FULL}/{metric}") for metric in metrics]
        figures = [
            "" if value is None else units.figure(metric, value)
            for metric, value in zip(metrics, values, strict=True)
        ]
        size = record["notes"].get("parameters", {}).get("task")
        cells = [*("" if value is None else str(value) for value in label), *figures]
        cells += ["" if size is None else f"{4e-6 * size:.1f}"]
        cells += [published] if any(theirs) else []
        place = (points or 0, *((value is not None, value or 0) for value in label[1:-1]), label[0])
        if place in rows:
            raise UserError(
                f"Two runs of {names['task']} by the same net are there, the second one in "
                f"{record['folder']}; give a folder with one of each."
            )
        rows[place] = cells
    title = f"No sampler was tested; {names['task']} on {names['dataset']} from all points."
    return Grid(title, columns, [rows[place] for place in sorted(rows)])


def _metrics(found: list[dict[str, Any]]) -> list[str]:
    """Return the metrics of all points: those that the task shows, or all."""
    names = {name for record in found for name in record["metrics"]}
    there = {name.rsplit("/", 1)[1] for name in names if name.startswith(f"test/{FULL}/")}
    shown = [name for name in found[0]["notes"].get("shown", ()) if name in there]
    # Errors normalized by those of all points are 1 here.
    return [name for name in shown or sorted(there) if not name.startswith("nre_")]


def _paper(record: dict[str, Any]) -> str:
    config = record["config"]
    task, net = config["names"]["task"], config["names"]["net"]
    pieces = (config["task"].get("net") or {}).get("pieces")
    points = config.get("dataset", {}).get("n_points", 0)
    figures = paper.net(net, pieces, points) if task == "reconstruction" else None
    if figures:
        return " / ".join(f"{value:g}" for value in figures)
    published = paper.table(task, config["names"]["dataset"], _score(record)).get("full")
    return "" if published is None else f"{published:.2f}"


def _score(record: dict[str, Any]) -> str:
    return record["notes"].get("score", "").rsplit("/", 1)[-1]
