"""``python -m mops_lightning.report FOLDER``: one table of all run records below a folder.

Reads ``result.json`` files only. As in the paper's tables, columns are sizes and a cell holds the
figures of generated / matched / completed sets, or one figure for samplers that choose input
points. Where the paper has them too, its figures stand in a row below ours. A folder of task nets
alone gives a table of nets.
"""

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mops_lightning import paper, records, units
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.io import atomic_write
from mops_lightning.readout_names import FULL, GENERATED_READOUTS, INDEX_READOUT, parse
from mops_lightning.report_nets import nets_table

Cells = dict[str, dict[int, dict[str, float]]]
"""sampler → m → readout → value."""


def main(arguments: list[str] | None = None) -> None:
    """Write ``table.md`` into the folder and print it."""
    parser = argparse.ArgumentParser(prog="python -m mops_lightning.report", description=__doc__)
    parser.add_argument("folder", type=Path, help="a run, a sweep, or any folder above records")
    parser.add_argument(
        "--metric", nargs="+", default=[], help="names behind the readout; default: the score"
    )
    chosen = parser.parse_args(arguments)
    try:
        text = table(chosen.folder, *chosen.metric)
    except UserError as error:
        print(f"mops_lightning.report: {error}", file=sys.stderr)
        sys.exit(2)
    path = chosen.folder / "table.md"
    with atomic_write(path) as temporary:
        temporary.write_text(text)
    print(text)
    print(f"written to {path}")


def table(folder: Path, *metrics: str) -> str:
    """Return Markdown tables of all completed records below ``folder``, one for each metric.

    Args:
        folder: the records' folder.
        metrics: what is shown; none: the score of the records' task.

    Raises:
        UserError: there is no record, or records of different tasks, data or task weights, whose
            figures must not stand in one table.
    """
    found, broken = [], []
    for path in sorted(folder.rglob(records.FILE)):
        try:
            found.append({**records.read(path.parent), "folder": str(path.parent)})
        except UserError:
            broken.append(str(path))
    if not found and not broken:
        raise UserError(f"{folder}: no {records.FILE} below it.")
    if not found:
        raise UserError(f"{folder}: none of its run records can be read: {', '.join(broken[:3])}.")
    done = [record for record in found if record["status"] == "completed"]
    if not done:
        raise UserError(f"{folder}: none of its {len(found)} runs is completed.")
    scored = [record for record in done if record["config"]["learn"] != "task"]
    if scored:
        names = _common(scored)
        lines = []
        for metric in metrics or [_score(scored)]:
            lines += [*_table(folder, scored, metric, names), ""]
        lines += _how([r for r in done if _task(r) == names["task"]], names["net"])
    else:
        lines = [*nets_table(done), "", *_how(done, "")]
    if len(done) < len(found):
        lines += ["", f"{len(found) - len(done)} of {len(found)} runs are not completed."]
    if broken:
        lines += ["", f"Not readable: {', '.join(broken)}."]
    return "\n".join(lines) + "\n"


def _table(
    folder: Path, scored: list[dict[str, Any]], metric: str, names: dict[str, str]
) -> list[str]:
    cells: Cells = {}
    own: set[tuple[str, int]] = set()
    for record in scored:
        _add(cells, own, record, metric, names["net"])
    if not cells:
        known = {parts.metric for r in scored for parts in map(parse, r["metrics"]) if parts}
        raise UserError(
            f"--metric: no run below {folder} has {metric!r}.{did_you_mean(metric, known)}"
        )
    sizes = sorted({m for values in cells.values() for m in values}, reverse=True)
    joint = names["what learned (learn)"] == "joint"
    published = paper.table(names["task"], names["dataset"], metric, joint)
    lines = [
        f"Test {units.title(metric)}: {names['task']} on {names['dataset']} under "
        f"{names['net']}; generated / matched / completed sets, or one figure for samplers that "
        "choose input points.",
        "",
        "| sampled by | " + " | ".join(f"m={m}" for m in sizes) + " |",
        "|---|" + "--:|" * len(sizes),
    ]
    for sampler in sorted(cells, key=_place):
        figures = [_figures(metric, cells[sampler].get(m)) for m in sizes]
        lines.append(_row(sampler, figures))
        if any(str(m) in published.get("rows", {}).get(sampler, {}) for m in sizes):
            theirs = [_paper_figures(published, sampler, m) for m in sizes]
            lines.append(_row("*the paper's*", theirs))
    return [*lines, "", *_full(scored, names["net"], metric, published)]


ORDER = (
    "random",
    "voxel",
    "fps",
    "poisson",
    "snet",
    "snet_progressive",
    "samplenet",
    "samplenet_progressive",
    "mops",
    "fmops",
)
"""Samplers as in the paper's tables; others by name behind them."""


def _place(sampler: str) -> tuple[int, str]:
    name = sampler.rsplit(" ", 1)[-1]  # behind "icp on"
    place = ORDER.index(name) if name in ORDER else len(ORDER)
    return place + len(ORDER) * (name != sampler) * 2, sampler


def _row(label: str, figures: list[str]) -> str:
    return f"| {label} | " + " | ".join(figures) + " |"


def _full(found: list[dict[str, Any]], net: str, metric: str, theirs: dict[str, Any]) -> list[str]:
    published = f" (the paper: {theirs['full']:.2f})" if "full" in theirs else ""
    lines: dict[str, None] = {}
    for record in found:
        value = record["metrics"].get(f"test/{FULL}/{metric}")
        joint = _learned(record) == "joint"
        with_ = (
            f" after joint training with {record['config']['names']['sampler']}" if joint else ""
        )
        if value is not None:
            here = record["config"]["names"]["net"]
            shown = f"{units.figure(metric, value)}{published if here == net else ''}"
            lines[f"{here} on all points{with_}: {shown}."] = None
    return list(lines)


def _common(found: list[dict[str, Any]]) -> dict[str, str]:
    """Return the names of task, net and data, which all records must share.

    A net without weights, such as ICP, may stand beside the trained one.
    """
    trained = [r for r in found if not _weightless(r)] or found
    keys = {
        "task": {r["config"]["names"]["task"] for r in found},
        "net": {r["config"]["names"]["net"] for r in trained},
        "dataset": {r["config"]["names"]["dataset"] for r in found},
        "data (dataset_fingerprint)": {r["notes"].get("dataset_fingerprint") for r in found},
        "pairs (task.pairs)": {_plain(r["config"]["task"].get("pairs")) for r in found},
        "what learned (learn)": {_learned(r) for r in trained},
        # After joint training each run has a task net of its own.
        "task weights (sha256)": {
            r["notes"].get("task_weights_sha256") for r in found if _learned(r) != "joint"
        },
    }
    for net in sorted({r["config"]["names"]["net"] for r in found}):
        same = [r["config"]["task"] for r in found if r["config"]["names"]["net"] == net]
        keys[f"settings of {net} (task.net)"] = {_plain(task.get("net")) for task in same}
    if any(_learned(r) == "joint" for r in trained):
        keys["loss (task.loss)"] = {_plain(r["config"]["task"].get("loss")) for r in trained}
    for what, values in keys.items():
        known = values - {None}  # a resumed run may have its task net from the checkpoint
        if len(known) > 1:
            raise UserError(
                f"The runs differ in {what}: {', '.join(sorted(map(str, known)))}. "
                "Their figures do not belong in one table; give a folder with runs of one kind."
            )
    return {what: next(iter(values - {None}), "") for what, values in keys.items()}


def _weightless(record: dict[str, Any]) -> bool:
    """Return whether the task net has no weights: none were noted, and none were trained."""
    learns = record["config"]["learn"] in ("task", "joint")
    return not learns and "task_weights_sha256" not in record["notes"]


def _plain(node: Any) -> str | None:
    return None if node is None else json.dumps(node, sort_keys=True)


def _task(record: dict[str, Any]) -> str:
    return record["config"]["names"]["task"]


def _score(found: list[dict[str, Any]]) -> str:
    """Return the metric that the records' tasks are scored by."""
    scores = [parse(record["notes"].get("score", "")) for record in found]
    return next((parts.metric for parts in scores if parts), "accuracy")


def _learned(record: dict[str, Any]) -> str:
    """Return whether the task net learned with the sampler, in the run that was evaluated too."""
    learn = (record["notes"].get("evaluated") or {}).get("learn", record["config"]["learn"])
    return "joint" if learn == "joint" else "sampler alone"


def _add(
    cells: Cells, own: set[tuple[str, int]], record: dict[str, Any], metric: str, net: str
) -> None:
    """Put a record's figures into the cells; a run of the sampler itself beats a baseline row.

    What another net than ``net`` made of a sampler's points is a row of its own.

    Raises:
        UserError: two runs would stand in one cell, where one would hide the other.
    """
    config = record["config"]
    other = "" if config["names"]["net"] == net else f"{config['names']['net']} on "
    sampler = other + config["names"]["sampler"]
    taken = set()
    for name, value in record["metrics"].items():
        parts = parse(name)
        if parts is None or parts.metric != metric or value is None or parts.readout == FULL:
            continue
        m = parts.m or config["m"]
        if parts.readout not in (INDEX_READOUT, *GENERATED_READOUTS):
            # After joint training each run has a task net, and baselines under it, of its own.
            row = other + parts.readout
            if (row, m) not in own and _learned(record) != "joint":
                cells.setdefault(row, {})[m] = {INDEX_READOUT: value}
            continue
        if (sampler, m) in own:
            raise UserError(
                f"Two runs of {sampler} with m={m} are there, the second one in "
                f"{record['folder']}; give a folder with one of each."
            )
        if (sampler, m) not in taken:
            cells.setdefault(sampler, {})[m] = {}
        taken.add((sampler, m))
        cells[sampler][m][parts.readout] = value
    own |= taken


def _paper_figures(published: dict[str, Any], sampler: str, m: int) -> str:
    values = published["rows"][sampler].get(str(m), [])
    return " / ".join(f"{value:.2f}" for value in values)


def _figures(metric: str, values: dict[str, float] | None) -> str:
    values = values or {}
    shown = [values[name] for name in (INDEX_READOUT, *GENERATED_READOUTS) if name in values]
    return " / ".join(units.figure(metric, value) for value in shown)


def _how(found: Iterable[dict[str, Any]], net: str) -> list[str]:
    """Say how each kind of run was made: epochs, seeds, device, commit; other nets are named."""
    lines: dict[str, None] = {}
    for record in found:
        config, names = record["config"], record["config"]["names"]
        what = names["net"] if config["learn"] == "task" else names["sampler"]
        trained = "fit" in record["seconds"]
        earlier = record["notes"].get("evaluated") or {}
        seed = earlier.get("seed", record["seed"])
        if names["net"] not in (net, what):
            what += f" under {names['net']}"
        joint = ", jointly trained" if _learned(record) == "joint" and trained else ""
        commit = (record["git"]["commit"] or "a wheel")[:10]
        lines[
            f"- {what}{joint}: "
            + (f"{config['trainer']['max_epochs']} epochs, " if trained else "")
            + (f"evaluated after {earlier['max_epochs']} epochs, " if earlier else "")
            + ("nothing to train, " if not trained and not earlier else "")
            + f"seed {seed}, {record['device']}, {record['threads']} threads, commit "
            + commit
            + (" with changes" if record["git"]["dirty"] else "")
        ] = None
    return list(lines)


if __name__ == "__main__":
    main()
