"""How the runs of a report were made, and which have no result."""

from collections.abc import Iterable
from pathlib import Path

from mops_lightning.records.run_record import RunRecord
from mops_lightning.report.collect import Found, epochs, sampler_row, seed, trained_with
from mops_lightning.report.comparable import commit

MAX_NAMED = 8
"""Most runs listed by name that were made in the same way."""


def provenance(found: Iterable[RunRecord], net: str) -> list[str]:
    """Return a line for each way in which runs were made: epochs, seed, device, commit.

    If runs of one kind were made in several ways, the lines name their folders.

    Args:
        found: completed records.
        net: the table's task net; other nets are named.
    """
    made: dict[str, dict[str, list[str]]] = {}
    for record in found:
        ways = made.setdefault(_kind(record, net), {})
        ways.setdefault(_way(record), []).append(Path(record.folder).name)
    lines = []
    for kind, ways in made.items():
        for way, folders in ways.items():
            listed = ""
            if len(ways) > 1 and len(folders) <= MAX_NAMED:
                listed = f" ({', '.join(folders)})"
            lines.append(f"- {kind}{listed}: {way}")
    return lines


def without_result(found: Found) -> list[str]:
    """Return a line for each run that is not completed, and their number."""
    if not found.undone:
        return []
    lines = [f"- {folder}: {why}" for folder, why in found.undone.items()]
    verb = "is" if len(lines) == 1 else "are"
    return [
        "",
        f"{len(lines)} of {len(found.done) + len(found.undone)} runs {verb} not completed:",
        "",
        *lines,
    ]


def _kind(record: RunRecord, net: str) -> str:
    names = record.config["names"]
    kind = names["net"] if record.config["learn"] == "task" else sampler_row(record)
    if names["net"] not in (net, kind):
        kind += f" under {names['net']}"
    joint = trained_with(record) == "joint" and "fit" in record.seconds
    return f"{kind}, jointly trained" if joint else kind


def _way(record: RunRecord) -> str:
    length = "nothing to train"
    if epochs(record) is not None:
        length = f"{epochs(record)} {'epoch' if epochs(record) == 1 else 'epochs'}"
    if "fit" not in record.seconds and epochs(record) is not None:
        length = f"evaluated after {length}"
    threads = "thread" if record.threads == 1 else "threads"
    changes = " with changes" if record.git["dirty"] else ""
    return (
        f"{length}, seed {seed(record)}, {record.device}, {record.threads} {threads}, "
        f"commit {commit(record)}{changes}"
    )
