"""Read the records of all runs below a folder."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.records.readout_names import FULL, parse_metric_name
from mops_lightning.records.run_record import ASIDE, FAILED, Names, RunRecord
from mops_lightning.records.summary import sampler_name, shown_names

MAX_LISTED = 3
"""Most runs that an error lists."""


@dataclass(frozen=True)
class Found:
    """The runs below a folder.

    Attributes:
        done: records of completed runs, sorted by folder.
        undone: folder → why it has no result, or one of a part of the test only.
    """

    done: list[RunRecord]
    undone: dict[str, str]


def collect(folder: Path) -> Found:
    """Read all records below ``folder``, except earlier attempts of a sweep's cells.

    Raises:
        UserError: there is no record, or none with a full result.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: folder not found. Give the folder of a run or a sweep.")
    done: list[RunRecord] = []
    undone: dict[str, str] = {}
    for place, record in _records(folder):
        if isinstance(record, str):
            undone[str(place)] = record
        elif record.status == "completed" and not record.partial:
            done.append(replace(record, folder=str(place)))
        else:
            undone[str(place)] = _why_undone(record)
    if not done and not undone:
        raise UserError(
            f"{folder}: no {run_record.FILE} or {run_record.MANY} found. Give the folder of a run "
            "or a sweep."
        )
    if not done:
        reasons = [f"{run} ({why})" for run, why in undone.items()]
        listed = "; ".join(reasons[:MAX_LISTED])
        raise UserError(f"{folder}: none of its {len(undone)} runs has a full result: {listed}.")
    return Found(done, undone)


def _why_undone(record: RunRecord) -> str:
    """Return the status of a run without a full result, with the reasons if it tells them."""
    reasons = " and ".join(record.partial) or record.error
    if not reasons:
        return record.status
    return f"{record.status}: {reasons}"


def _records(folder: Path) -> list[tuple[Path, RunRecord | str]]:
    """Return the folder of every run, sorted, with its record or the reason why it has none."""
    records: dict[Path, RunRecord | str] = {}
    for path in folder.rglob(run_record.MANY):
        for number, line in enumerate(_lines(path), 1):
            place = f"{path}, line {number}"
            try:
                record = run_record.from_json(line, place)
                records[path.parent / record.folder] = record
            except UserError as error:
                records[Path(place)] = str(error)
    paths = [*folder.rglob(run_record.FILE), *folder.rglob(FAILED)]
    runs = {path.parent for path in paths if ASIDE not in path.parts}
    for run in runs:
        try:
            records[run] = run_record.read(run)
        except UserError as error:
            failure = "\n".join(_lines(run / FAILED)).strip()  # the last start of a sweep's cell
            records[run] = failure or str(error)
    return [(place, records[place]) for place in sorted(records)]


def _lines(path: Path) -> list[str]:
    """Return the lines of a regular file; other files give none."""
    if not path.is_file():
        return []
    return path.read_text(errors="replace").splitlines()


def names(record: RunRecord) -> Names:
    """Return the names of a record's groups, as titles and rows show them."""
    return shown_names(record.config)


def trained_with(record: RunRecord) -> str:
    """Return whether the task net was trained with the sampler, also in an evaluated run."""
    learn = record.config["learn"]
    if record.evaluated:
        learn = record.evaluated.learn
    if learn == "joint":
        return "joint"
    return "sampler alone"


def recorded_recipe(record: RunRecord) -> dict[str, Any]:
    """Return the recipe that a record's sampler was trained by, with its name; {}: the paper's."""
    if record.recipe:
        return record.recipe
    if record.evaluated and record.evaluated.recipe:
        return record.evaluated.recipe
    return {}


def sampler_row(record: RunRecord) -> str:
    """Return the name of a record's sampler, with the settings that make it a separate row.

    That is ``anchored`` for a MOPS-Net with anchors, its recipe unless it is the paper's, and the
    number of task nets that it was trained under if there were several.
    """
    row = sampler_name(record.config)
    recipe = recorded_recipe(record).get("name")
    if recipe and recipe != "paper":  # the paper's is recorded where a setting of it was changed
        row += f" {recipe}"
    others = record.config.get("other_nets")
    if others:
        row += f" {1 + len(others)} nets"
    return row.strip()


def training_time(found: list[RunRecord]) -> tuple[str, list[float | None]]:
    """Return the head of a column, and the seconds that every run was trained; None: not at all.

    They are CPU time if all runs have recorded it, otherwise wall time.
    """
    head = "training (wall)"
    stage = "fit"
    trained = [record for record in found if "fit" in record.seconds]
    if trained and all("fit_cpu" in record.seconds for record in trained):
        head = "training (CPU)"
        stage = "fit_cpu"
    return head, [record.seconds.get(stage) for record in found]


def epochs(record: RunRecord) -> int | None:
    """Return the epochs that a run, or the run that it evaluates, was trained; None: untrained."""
    if "fit" in record.seconds:
        return record.config["trainer"]["max_epochs"]
    if record.evaluated is None:
        return None
    return record.evaluated.max_epochs


def seed(record: RunRecord) -> int:
    """Return the seed of a run, or of the run that it evaluates."""
    if record.evaluated is None:
        return record.seed
    return record.evaluated.seed


def tested_metrics(found: list[RunRecord]) -> set[str]:
    """Return the names of the metrics that a sampled set of a record was tested by."""
    metrics = set()
    for record in found:
        for key in record.metrics:
            name = parse_metric_name(key)
            if name is not None and name.readout != FULL:
                metrics.add(name.metric)
    return metrics


def score(found: list[RunRecord]) -> str:
    """Return the name of the records' main metric; empty if none names it."""
    for record in found:
        name = parse_metric_name(record.score_name)
        if name is not None:
            return name.metric
    return ""


def plain_number(value: Any) -> Any:
    """Return a setting, whole numbers as integers, so that 30 and 30.0 give the same text."""
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def text_to_compare(value: Any) -> str:
    """Return a text that two settings share if they are equal: ``None`` and ``'None'`` are not."""
    return repr(plain_number(value))
