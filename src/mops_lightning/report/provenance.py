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
    made = pd.DataFrame(
        {
            "kind": [_kind(record, net) for record in found],
            "way": [_way(record) for record in found],
            "folder": [Path(record.folder).name for record in found],
        }
    )
    lines = []
    for kind, runs in made.groupby("kind", sort=False):
        ways = runs.groupby("way", sort=False)["folder"]
        for way, folders in ways:
            made_so = str(kind)
            if len(ways) > 1 and len(folders) <= MAX_NAMED:
                made_so += f" ({', '.join(folders)})"
            lines.append(f"- {made_so}: {way}")
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
    of_kinds: dict[str, list[RunRecord]] = defaultdict(list)
    for record in found:
        if collapsed(record):
            of_kinds[_kind(record, net)].append(record)
    lines = []
    for kind, records in of_kinds.items():
        counts: dict[int, list[float]] = defaultdict(list)
        for record in records:
            for m, count in collapsed(record).items():
                counts[m].append(count)
        means = [f"{mean(counts[m]):.1f} of {m}" for m in sorted(counts)]
        shown = ", ".join(means)
        hint = advice(records[-1])
        text = f"collapsed: only {shown} matched points are distinct. {hint}."
        lines.append(f"- {kind}: {text}")
    return lines


def without_result(found: collect.Found) -> list[str]:
    """Return a line for each run without a full result, and their number."""
    if not found.undone:
        return []
    lines = [f"- {folder}: {why}" for folder, why in found.undone.items()]
    verb = "have"
    if len(lines) == 1:
        verb = "has"
    number = len(found.done) + len(lines)
    head = f"{len(lines)} of {number} runs {verb} no full result:"
    return ["", head, "", *lines]


def _kind(record: RunRecord, net: str) -> str:
    """Return what a run trained or tested: a net, or a sampler with its net."""
    own_net = collect.names(record)["net"]
    kind = collect.sampler_row(record)
    if record.config["learn"] == "task":
        kind = own_net
    if own_net not in (net, kind):
        kind += f" under {own_net}"
    if collect.trained_with(record) == "joint" and "fit" in record.seconds:
        kind += ", jointly trained"
    return kind


def _way(record: RunRecord) -> str:
    """Return how long, where and from which code a run was made."""
    threads = f"{record.threads} threads"
    if record.threads == 1:
        threads = "1 thread"
    code = f"commit {commit(record)}"
    if record.git["dirty"]:
        code += " with changes"
    seed = f"seed {collect.seed(record)}"
    facts = [_length(record), seed, str(record.device), threads, code]
    tags = record.config.get("tags")
    if tags:
        facts.append(f"tags {' '.join(tags)}")
    return ", ".join(facts)


def _length(record: RunRecord) -> str:
    """Return how long a run, or the run that it evaluates, was trained."""
    number = collect.epochs(record)
    if number is None:
        return "nothing to train"
    epochs = f"{number} epochs"
    if number == 1:
        epochs = "1 epoch"
    if "fit" in record.seconds:
        return epochs
    return f"evaluated after {epochs}"
