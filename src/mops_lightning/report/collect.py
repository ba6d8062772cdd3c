"""Which runs lie below a folder, and whether their figures may stand in one table."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.records.attempts import ASIDE, FAILED
from mops_lightning.records.metric_info import in_summary_order, metric_info
from mops_lightning.records.readout_names import parse

Record = dict[str, Any]
"""A run record, and ``folder``, where it lies."""


@dataclass(frozen=True)
class Found:
    """What lies below a folder.

    Attributes:
        done: records of completed runs, in the order of their folders.
        undone: folder → why it has no result.
        count: runs and cells altogether.
    """

    done: list[Record]
    undone: dict[str, str]
    count: int


def collect(folder: Path) -> Found:
    """Read all records below ``folder``; earlier attempts of a sweep's cells do not count.

    Raises:
        UserError: there is none, or none is of a completed run.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder. Give a run's, a sweep's or any above records.")
    done: list[Record] = []
    undone: dict[str, str] = {}
    paths = [*folder.rglob(run_record.FILE), *folder.rglob(FAILED)]
    runs = sorted({path.parent for path in paths if ASIDE not in path.parts})
    if not runs:
        raise UserError(f"{folder}: no {run_record.FILE} below it.")
    for run in runs:
        try:
            record = run_record.read(run)
        except UserError:
            text = (run / FAILED).read_text() if (run / FAILED).exists() else "not readable"
            undone[str(run)] = text.strip()
            continue
        if record["status"] == "completed":
            done.append({**record, "folder": str(run)})
        else:
            why = f": {record['error']}" if record["error"] else ""
            undone[str(run)] = record["status"] + why
    if not done:
        listed = "; ".join(f"{run} ({why})" for run, why in list(undone.items())[:3])
        raise UserError(f"{folder}: none of its {len(runs)} runs is completed: {listed}.")
    return Found(done, undone, len(runs))


def common(found: list[Record], mixed: bool = False) -> dict[str, str]:
    """Return the names of task, net, data and ``learned``, which all records must share.

    A net without weights, such as ICP, may stand beside the trained one.

    Args:
        found: completed records.
        mixed: whether different commits are allowed.

    Raises:
        UserError: they differ in what must be equal; it says in what.
    """
    trained = [r for r in found if not _weightless(r)] or found
    keys = {
        "task": {r["config"]["names"]["task"] for r in found},
        "net": {r["config"]["names"]["net"] for r in trained},
        "dataset": {r["config"]["names"]["dataset"] for r in found},
        "pairs (task.pairs)": {_plain(r["config"]["task"].get("pairs")) for r in found},
        "what learned (learn)": {learned(r) for r in trained},
    }
    for net in sorted({r["config"]["names"]["net"] for r in found}):
        same = [r["config"]["task"] for r in found if r["config"]["names"]["net"] == net]
        keys[f"settings of {net} (task.net)"] = {_plain(task.get("net")) for task in same}
    if any(learned(r) == "joint" for r in trained):
        keys["loss (task.loss)"] = {_plain(r["config"]["task"].get("loss")) for r in trained}
    for what, values in keys.items():
        known = values - {None}
        if len(known) > 1:
            raise UserError(
                f"The runs differ in {what}: {', '.join(sorted(map(str, known)))}. "
                "Their figures do not belong in one table; give a folder with runs of one kind."
            )
    same_for_every_seed("data (dataset_fingerprint)", "dataset_fingerprint", found)
    # After joint training each run has a task net of its own.
    alone = [r for r in found if learned(r) != "joint"]
    same_for_every_seed("task weights (sha256)", "task_weights_sha256", alone)
    one_commit(found, mixed)
    names = {what: next(iter(values - {None}), "") for what, values in keys.items()}
    sizes = "/".join(str(m) for m in sorted({record["config"]["m"] for record in found}))
    return {**names, "learned": names["what learned (learn)"], "m": sizes}


def one_commit(found: list[Record], mixed: bool) -> None:
    """Refuse runs of different commits unless asked for."""
    commits = sorted({(r["git"]["commit"] or "a wheel")[:10] for r in found})
    if len(commits) > 1 and not mixed:
        raise UserError(
            f"The runs differ in the commit of the code: {', '.join(commits)}. If their figures "
            "may stand in one table all the same, add --mixed."
        )


def same_for_every_seed(what: str, note: str, found: list[Record]) -> None:
    """Refuse runs of one seed with different data or nets.

    Each seed may have its own, as procedural data and nets that are trained first have; then every
    sampler must have been run with every seed.
    """
    by_seed: dict[int, set[str]] = {}
    seeds: dict[str, set[int]] = {}
    for record in found:
        if known := record["notes"].get(note):  # a resumed run may have its net from a checkpoint
            by_seed.setdefault(seed(record), set()).add(known)
            seeds.setdefault(record["config"]["names"]["sampler"], set()).add(seed(record))
    everything = sorted({one for values in by_seed.values() for one in values})
    mixed = any(len(values) > 1 for values in by_seed.values())
    uneven = len(everything) > 1 and len({frozenset(values) for values in seeds.values()}) > 1
    if mixed or uneven:
        listed = ", ".join(one[:12] for one in everything)
        hint = " (with one for each seed, every sampler must have every seed)" if uneven else ""
        raise UserError(
            f"The runs differ in {what}: {listed}{hint}. Their figures do not belong in one table; "
            "give a folder with runs of one kind."
        )


def learned(record: Record) -> str:
    """Return whether the task net learned with the sampler, in the run that was evaluated too."""
    learn = (record["notes"].get("evaluated") or {}).get("learn", record["config"]["learn"])
    return "joint" if learn == "joint" else "sampler alone"


def epochs(record: Record) -> int | None:
    """Return how long a run, or the one that it evaluates, was trained; None: not at all."""
    earlier = record["notes"].get("evaluated") or {}
    if "fit" in record["seconds"]:
        return record["config"]["trainer"]["max_epochs"]
    return earlier.get("max_epochs")


def score(found: list[Record]) -> str:
    """Return the name of the records' main metric.

    Early records do not name it; it is the first one of the closing table.
    """
    for record in found:
        if parts := parse(record["notes"].get("score", "")):
            return parts.metric
    names = {parts.metric for record in found for parts in map(parse, record["metrics"]) if parts}
    infos = in_summary_order(metric_info(name, found) for name in names)
    return infos[0].name if infos else ""


def seed(record: Record) -> int:
    """Return the seed of a run, or of the one that it evaluates."""
    earlier: Record = record["notes"].get("evaluated") or {}
    return earlier["seed"] if "seed" in earlier else record["seed"]


def _weightless(record: Record) -> bool:
    """Return whether the task net has no weights: none were noted, and none were trained."""
    learns = record["config"]["learn"] in ("task", "joint")
    return not learns and "task_weights_sha256" not in record["notes"]


def _plain(node: Any) -> str | None:
    return None if node is None else json.dumps(node, sort_keys=True)
