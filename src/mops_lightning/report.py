"""``python -m mops_lightning.report FOLDER``: one table of all run records below a folder.

Reads ``result.json`` files only. Rows are what sampled the points, columns are sizes; where the
paper has the figure it stands behind ours in brackets.
"""

import argparse
import json
import sys
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path
from typing import Any

from mops_lightning import records
from mops_lightning.errors import UserError
from mops_lightning.io import atomic_write
from mops_lightning.readout_names import FULL, GENERATED_READOUTS, INDEX_READOUT

Cells = dict[tuple[str, str], dict[int, float]]
"""(sampler, readout) → m → value."""


def main(arguments: list[str] | None = None) -> None:
    """Write ``table.md`` into the folder and print it."""
    parser = argparse.ArgumentParser(prog="python -m mops_lightning.report", description=__doc__)
    parser.add_argument("folder", type=Path, help="a run, a sweep, or any folder above records")
    parser.add_argument("--metric", default="accuracy", help="name behind the readout")
    chosen = parser.parse_args(arguments)
    try:
        text = table(chosen.folder, chosen.metric)
    except UserError as error:
        print(f"mops_lightning.report: {error}", file=sys.stderr)
        sys.exit(2)
    path = chosen.folder / "table.md"
    with atomic_write(path) as temporary:
        temporary.write_text(text)
    print(text)
    print(f"written to {path}")


def table(folder: Path, metric: str = "accuracy") -> str:
    """Return a Markdown table of all completed records below ``folder``.

    Raises:
        UserError: there is no record, or records of different tasks, data or task weights, whose
            figures must not stand in one table.
    """
    found = [records.read(path.parent) for path in sorted(folder.rglob(records.FILE))]
    if not found:
        raise UserError(f"{folder}: no {records.FILE} below it.")
    done = [record for record in found if record["status"] == "completed"]
    if not done:
        raise UserError(f"{folder}: none of its {len(found)} runs is completed.")
    scored = [record for record in done if record["config"]["learn"] != "task"] or done
    names = _common(scored)
    cells: Cells = {}
    _refuse_doubles(scored)
    for record in scored:
        _add(cells, record, metric)
    sizes = sorted({m for values in cells.values() for m in values}, reverse=True)
    paper = _paper(names["task"], metric)
    lines = [
        f"Test {metric.replace('_', ' ')} in %, {names['task']} on {names['dataset']} under "
        f"{names['net']}; in brackets the paper's figure.",
        "",
        "| sampled by | readout | " + " | ".join(f"m={m}" for m in sizes) + " |",
        "|---|---|" + "--:|" * len(sizes),
    ]
    for (sampler, readout), values in sorted(cells.items(), key=_place):
        shown = [_cell(values.get(m), _paper_value(paper, sampler, readout, m)) for m in sizes]
        lines.append(f"| {sampler} | {readout} | " + " | ".join(shown) + " |")
    lines += ["", *_how(done)]
    if len(done) < len(found):
        lines += ["", f"{len(found) - len(done)} of {len(found)} runs are not completed."]
    return "\n".join(lines) + "\n"


ORDER = ("random", "voxel", "fps")
"""Unlearned samplers first; others by name, then the full clouds."""


def _place(item: tuple[tuple[str, str], dict[int, float]]) -> tuple[bool, int, str, int]:
    (sampler, readout), _ = item
    readouts = (INDEX_READOUT, *GENERATED_READOUTS, FULL)
    rank = ORDER.index(sampler) if sampler in ORDER else len(ORDER)
    return readout == FULL, rank, sampler, readouts.index(readout)


def _common(found: list[dict[str, Any]]) -> dict[str, str]:
    """Return the names of task, net and data, which all records must share."""
    keys = {
        "task": {r["config"]["names"]["task"] for r in found},
        "net": {r["config"]["names"]["net"] for r in found},
        "dataset": {r["config"]["names"]["dataset"] for r in found},
        "data (dataset_fingerprint)": {r["notes"].get("dataset_fingerprint") for r in found},
        "task weights (sha256)": {r["notes"].get("task_weights_sha256") for r in found},
    }
    for what, values in keys.items():
        known = values - {None}  # a resumed run may have its task net from the checkpoint
        if len(known) > 1:
            raise UserError(
                f"The runs differ in {what}: {', '.join(sorted(map(str, known)))}. "
                "Their figures do not belong in one table; give a folder with runs of one kind."
            )
    return {what: next(iter(values - {None}), "") for what, values in keys.items()}


def _refuse_doubles(found: list[dict[str, Any]]) -> None:
    """Refuse two runs that would stand in the same cells, where one would hide the other."""
    seen = set()
    for record in found:
        config = record["config"]
        cell = f"{config['names']['sampler']} with m={config['m']}"
        if config["learn"] != "task" and cell in seen:
            raise UserError(f"Two runs of {cell} are there; give a folder with one of each.")
        seen.add(cell)


def _add(cells: Cells, record: dict[str, Any], metric: str) -> None:
    """Put a record's figures into the cells; a run of the sampler itself beats a baseline row."""
    names, m = record["config"]["names"], record["config"]["m"]
    for name, value in record["metrics"].items():
        parts = name.split("/")
        if len(parts) != 3 or parts[0] != "test" or parts[2] != metric or value is None:
            continue
        readout = parts[1]
        if readout == FULL:
            cells.setdefault((names["net"], FULL), {})[m] = value
        elif readout in (INDEX_READOUT, *GENERATED_READOUTS):
            cells.setdefault((names["sampler"], readout), {})[m] = value
        else:
            cells.setdefault((readout, INDEX_READOUT), {}).setdefault(m, value)


def _paper(task: str, metric: str) -> dict[str, Any]:
    text = files("mops_lightning").joinpath("paper.json").read_text()
    entry = json.loads(text).get(task, {})
    return entry if entry.get("metric") == metric else {}


def _paper_value(paper: dict[str, Any], sampler: str, readout: str, m: int) -> float | None:
    if readout == FULL:
        return paper.get("full")
    values = paper.get("rows", {}).get(sampler, {}).get(str(m))
    if values is None:
        return None
    place = 0 if readout == INDEX_READOUT else GENERATED_READOUTS.index(readout)
    return values[place]


def _cell(value: float | None, paper: float | None) -> str:
    if value is None:
        return ""
    return f"{100 * value:.2f}" + ("" if paper is None else f" ({paper:.2f})")


def _how(found: Iterable[dict[str, Any]]) -> list[str]:
    """Say how each kind of run was made: epochs, seeds, device, commit."""
    lines: dict[str, None] = {}
    for record in found:
        config, names = record["config"], record["config"]["names"]
        what = names["net"] if config["learn"] == "task" else names["sampler"]
        trained = "fit" in record["seconds"]
        commit = (record["git"]["commit"] or "a wheel")[:10]
        lines[
            f"- {what}: "
            + (f"{config['trainer']['max_epochs']} epochs, " if trained else "nothing to train, ")
            + f"seed {record['seed']}, {record['device']}, {record['threads']} threads, commit "
            + commit
            + (" with changes" if record["git"]["dirty"] else "")
        ] = None
    return list(lines)


if __name__ == "__main__":
    main()
