"""Read the records of all runs below a folder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.records.metric_info import in_summary_order, metric_info
from mops_lightning.records.readout_names import parse
from mops_lightning.records.run_record import ASIDE, FAILED, RunRecord
from mops_lightning.records.summary import sampler_name


@dataclass(kw_only=True)
class Record(RunRecord):
    """A run record with the path of its folder."""

    folder: str


NEEDED = {
    "properties": {
        "config": {
            "required": ["task"],
            "properties": {
                "task": {"type": "object", "properties": {"net": {"type": ["object", "null"]}}},
                "trainer": {
                    "required": ["max_epochs"],
                    "properties": {"max_epochs": {"type": "integer"}},
                },
            },
        },
        "git": {"properties": {"commit": {"type": ["string", "null"]}}},
    },
}
"""The parts of a completed record that tables need, beyond the schema of all records."""


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
            if record.status == "completed":
                _check(record, run)
                done.append(Record(**vars(record), folder=str(run)))
                continue
            why = f": {record.error}" if record.error else ""
            undone[str(run)] = record.status + why
        except UserError as error:
            undone[str(run)] = _failure(run) or str(error)
    if not done:
        listed = "; ".join(f"{run} ({why})" for run, why in list(undone.items())[:3])
        raise UserError(f"{folder}: none of its {len(runs)} runs is completed: {listed}.")
    return Found(done, undone, len(runs))


def _check(record: RunRecord, run: Path) -> None:
    """Reject a record without what tables need, which one table with others would fail at.

    Raises:
        UserError: something is missing or of another type.
    """
    import jsonschema

    try:
        jsonschema.validate(record.plain(), NEEDED)
    except jsonschema.ValidationError as error:
        place = ".".join(map(str, error.absolute_path)) or "record"
        raise UserError(f"{run / run_record.FILE}: {place}: {error.message[:200]}") from None


def _failure(run: Path) -> str:
    """Return why the last start of a sweep's cell failed; empty if nothing says so."""
    try:
        return (run / FAILED).read_text(errors="replace").strip()
    except OSError:
        return ""


def trained_with(record: Record) -> str:
    """Return whether the task net was trained with the sampler, also in an evaluated run."""
    learn = record.evaluated.learn if record.evaluated else record.config["learn"]
    return "joint" if learn == "joint" else "sampler alone"


def recipe(record: Record) -> dict[str, Any]:
    """Return the recipe that a record's sampler was trained by, with its name; {}: the paper's."""
    return record.recipe or (record.evaluated and record.evaluated.recipe) or {}


def sampler_row(record: Record) -> str:
    """Return the name of a record's sampler, with what makes it a row of its own.

    That is ``anchored`` for a MOPS-Net with anchors, and its recipe unless it is the paper's.
    """
    parts = [sampler_name(record.config), recipe(record).get("name")]
    return " ".join(filter(None, parts))


def epochs(record: Record) -> int | None:
    """Return the epochs that a run, or the run that it evaluates, was trained; None: untrained."""
    if "fit" in record.seconds:
        return record.config["trainer"]["max_epochs"]
    return record.evaluated.max_epochs if record.evaluated else None


def seed(record: Record) -> int:
    """Return the seed of a run, or of the run that it evaluates."""
    return record.evaluated.seed if record.evaluated else record.seed


def score(found: list[Record]) -> str:
    """Return the name of the records' main metric.

    Early records do not name it; it is the first metric of the closing table.
    """
    for record in found:
        if parts := parse(record.score_name):
            return parts.metric
    names = {parts.metric for record in found for parts in map(parse, record.metrics) if parts}
    infos = in_summary_order(metric_info(name, found) for name in names)
    return infos[0].name if infos else ""
