"""Samplers that have collapsed: most of their points lie on few points of the cloud.

A task net can score such a sample well, for it was trained for this net alone. As a sample of the
cloud it is worthless, and the score does not show it.
"""

from mops_lightning.records.readout_names import parse_metric_name
from mops_lightning.records.run_record import RunRecord

UNIQUE = "unique_points"
"""The metric that counts the distinct matched points of a cloud."""

FEWEST = 0.5
"""Share of m below which the mean number of distinct points means a collapse."""

TRY_OVERLAP = "Try sampler.overlap=10 or sampler.anchors=fps (docs/samplers.md)"
TRY_COMPLETED = "Use the completed set, whose points are distinct"


def distinct_points(record: RunRecord) -> dict[int, float]:
    """Return the mean number of distinct matched points of the test clouds, by size.

    Args:
        record: of a run; those without a generating sampler have no such number.
    """
    counts: dict[int, float] = {}
    for key, value in record.metrics.items():
        name = parse_metric_name(key)
        if name is None or name.metric != UNIQUE or value is None:
            continue
        m = name.m or record.config["m"]
        counts[m] = value
    return counts


def collapsed(record: RunRecord) -> dict[int, float]:
    """Return the sizes at which a run's sampler has collapsed, with its distinct points."""
    counts = distinct_points(record)
    return {m: count for m, count in counts.items() if count < FEWEST * m}


def advice(record: RunRecord) -> str:
    """Return what to try: a penalty on equal choices, where the sampler has one."""
    sampler = record.config.get("sampler") or {}
    if "overlap" in sampler:
        return TRY_OVERLAP
    return TRY_COMPLETED


def collapse_line(record: RunRecord) -> str:
    """Return one line about a collapsed sampler and what to try; empty if it has not collapsed."""
    found = collapsed(record)
    if not found:
        return ""
    texts = [f"{count:.1f} of {m}" for m, count in found.items()]
    counts = ", ".join(texts)
    return f"collapsed: only {counts} matched points are distinct. {advice(record)}."
