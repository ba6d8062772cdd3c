"""What the readouts and their metrics are called, in logs, records and tables."""

from typing import NamedTuple

GENERATED_READOUTS = ("generated", "matched", "completed")
"""Straight out of the sampler; nearest input points; these made unique and filled up by FPS."""
INDEX_READOUT = "sampled"
"""Index samplers choose input points, so their three readouts are one."""
FULL = "full"
"""The cloud before sampling: what the task net can do at best."""
SOFT_PROJECTED = "soft_projected"
"""What SampleNet's task net sees in training; logged under ``train/`` alone, never a result."""

ROWS = (*GENERATED_READOUTS, INDEX_READOUT, FULL)
"""Readouts in the order of tables, after the baselines."""


class MetricName(NamedTuple):
    """A test metric's name in its parts.

    Attributes:
        m: the size, or None where the run tests one size only.
        readout: of the sampler under test, a baseline's name, or ``full``.
        metric: such as ``accuracy``.
    """

    m: int | None
    readout: str
    metric: str


def size_prefix(m: int | None) -> str:
    """Return ``m32/`` for 32, and nothing for None."""
    return "" if m is None else f"m{m}/"


def parse(name: str, stage: str = "test") -> MetricName | None:
    """Take a name such as ``test/m32/generated/accuracy`` or ``test/generated/accuracy`` apart.

    Returns:
        None for names of another stage, of losses and of the sampling matrix.
    """
    first, *parts = name.split("/")
    m = None
    if len(parts) == 3 and parts[0][:1] == "m" and parts[0][1:].isdecimal():
        m = int(parts.pop(0)[1:])
    if first != stage or len(parts) != 2 or parts[0] in ("loss", "matrix"):
        return None
    return MetricName(m, parts[0], parts[1])
