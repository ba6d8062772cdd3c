"""Read the records of all runs below a folder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.records.attempts import ASIDE, FAILED
from mops_lightning.records.metric_info import in_summary_order, metric_info
from mops_lightning.records.readout_names import parse

Record = dict[str, Any]
"""A run record, with its path under ``folder``."""


@dataclass(frozen=True)
class Found:
    """The runs below a folder.

    Attributes:
        done: records of completed runs, sorted by folder.
        undone: folder → why it has no result.
        count: number of runs, completed or not.
    """

    done: list[Record]
    undone: dict[str, str]
    count: int


def collect(folder: Path) -> Found:
    """Read all records below ``folder``, except earlier attempts of a sweep's cells.

    Raises:
        UserError: there is no record, or none of a completed run.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: folder not found. Give the folder of a run or a sweep.")
    done: list[Record] = []
    undone: dict[str, str] = {}
    paths = [*folder.rglob(run_record.FILE), *folder.rglob(FAILED)]
    runs = sorted({path.parent for path in paths if ASIDE not in path.parts})
    if not runs:
        raise UserError(
            f"{folder}: no {run_record.FILE} found. Give the folder of a run or a sweep."
        )
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


def trained_with(record: Record) -> str:
    """Return whether the task net was trained with the sampler, also in an evaluated run."""
    learn = (record["notes"].get("evaluated") or {}).get("learn", record["config"]["learn"])
    return "joint" if learn == "joint" else "sampler alone"


def recipe(record: Record) -> dict[str, Any]:
    """Return the recipe that a record's sampler was trained by, with its name; {}: the paper's."""
    notes = record["notes"]
    return notes.get("recipe") or (notes.get("evaluated") or {}).get("recipe") or {}


def sampler_row(record: Record) -> str:
    """Return the name of a record's sampler, with that of its recipe unless it is the paper's."""
    sampler: str = record["config"]["names"]["sampler"]
    return " ".join([sampler, *filter(None, [recipe(record).get("name")])])


def epochs(record: Record) -> int | None:
    """Return the epochs that a run, or the run that it evaluates, was trained; None: untrained."""
    earlier = record["notes"].get("evaluated") or {}
    if "fit" in record["seconds"]:
        return record["config"]["trainer"]["max_epochs"]
    return earlier.get("max_epochs")


def seed(record: Record) -> int:
    """Return the seed of a run, or of the run that it evaluates."""
    earlier: Record = record["notes"].get("evaluated") or {}
    return earlier["seed"] if "seed" in earlier else record["seed"]


def score(found: list[Record]) -> str:
    """Return the name of the records' main metric.

    Early records do not name it; it is the first metric of the closing table.
    """
    for record in found:
        if parts := parse(record["notes"].get("score", "")):
            return parts.metric
    names = {parts.metric for record in found for parts in map(parse, record["metrics"]) if parts}
    infos = in_summary_order(metric_info(name, found) for name in names)
    return infos[0].name if infos else ""
