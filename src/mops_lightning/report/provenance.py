"""The lines below a report: how its runs were made, and which have no result."""

from collections import defaultdict
from pathlib import Path
from statistics import mean

import pandas as pd

from mops_lightning.records.collapse import advice, collapsed
from mops_lightning.records.run_record import RunRecord
from mops_lightning.report import collect
from mops_lightning.report.comparable import commit

MAX_NAMED = 8
"""Most runs listed by name that were made in the same way."""


def provenance(found: list[RunRecord], net: str) -> list[str]:
    """Return a line for each way in which runs were made: epochs, seed, device, commit.

    If runs of one kind were made in several ways, the lines name their folders.

    Args:
        found: completed records.
        net: the table's task net; other nets are named.
    """
    rows = [(_kind(record, net), _way(record), Path(record.folder).name) for record in found]
    made = pd.DataFrame(rows, columns=["kind", "way", "folder"])
    lines = []
    for kind, runs in made.groupby("kind", sort=False):
        ways = runs.groupby("way", sort=False)["folder"]
        for way, folders in ways:
            is_named = len(ways) > 1 and len(folders) <= MAX_NAMED
            listed = f" ({', '.join(folders)})" if is_named else ""
            lines.append(f"- {kind}{listed}: {way}")
    return lines


def edited(found: list[RunRecord]) -> list[str]:
    """Return a line for each record that was changed after its run."""
    return [
        f"- {record.folder}: the record was edited after the run: its digest does not fit"
        for record in found
        if record.is_edited
    ]


def collapses(found: list[RunRecord], net: str) -> list[str]:
    """Return a line for each kind of runs whose sampler has collapsed, over all seeds.

    Args:
        found: completed records.
        net: the table's task net; other nets are named.
    """
    counts: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    advices: dict[str, str] = {}
    for record in found:
        for m, count in collapsed(record).items():
            kind = _kind(record, net)
            counts[kind][m].append(count)
            advices[kind] = advice(record)
    lines = []
    for kind, by_size in counts.items():
        means = [f"{mean(values):.1f} of {m}" for m, values in sorted(by_size.items())]
        shown = ", ".join(means)
        text = f"collapsed: only {shown} matched points are distinct. {advices[kind]}."
        lines.append(f"- {kind}: {text}")
    return lines


def without_result(found: collect.Found) -> list[str]:
    """Return a line for each run without a full result, and their number."""
    if not found.undone:
        return []
    lines = [f"- {folder}: {why}" for folder, why in found.undone.items()]
    verb = "has" if len(lines) == 1 else "have"
    number = len(found.done) + len(lines)
    return ["", f"{len(lines)} of {number} runs {verb} no full result:", "", *lines]


def _kind(record: RunRecord, net: str) -> str:
    own_net = collect.names(record)["net"]
    kind = own_net if record.config["learn"] == "task" else collect.sampler_row(record)
    if own_net not in (net, kind):
        kind += f" under {own_net}"
    if collect.trained_with(record) == "joint" and "fit" in record.seconds:
        kind += ", jointly trained"
    return kind


def _way(record: RunRecord) -> str:
    threads = "thread" if record.threads == 1 else "threads"
    changes = " with changes" if record.git["dirty"] else ""
    tags = record.config.get("tags")
    tagged = f", tags {' '.join(tags)}" if tags else ""
    return (
        f"{_length(record)}, seed {collect.seed(record)}, {record.device}, "
        f"{record.threads} {threads}, commit {commit(record)}{changes}{tagged}"
    )


def _length(record: RunRecord) -> str:
    """Return how long a run, or the run that it evaluates, was trained."""
    number = collect.epochs(record)
    if number is None:
        return "nothing to train"
    epochs = "1 epoch" if number == 1 else f"{number} epochs"
    return epochs if "fit" in record.seconds else f"evaluated after {epochs}"
