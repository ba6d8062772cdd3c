"""Names of readouts and test metrics in logs, records and tables."""

from typing import NamedTuple

GENERATED = "generated"
"""The sampler's output."""
MATCHED = "matched"
"""The nearest input points of the generated points."""
COMPLETED = "completed"
"""The matched points, made unique and completed by farthest points."""
GENERATED_READOUTS = (GENERATED, MATCHED, COMPLETED)
"""The readouts of every sampler that generates points."""
PROJECTED = "projected"
"""SampleNet's soft projection of the generated points: what its task net is trained on."""
INDEX_READOUT = "sampled"
"""The only readout of samplers that choose input points."""
FULL = "full"
"""The cloud before sampling, as a reference."""

ROWS = (*GENERATED_READOUTS, PROJECTED, INDEX_READOUT, FULL)
"""Readouts in the order of tables, after the baselines."""

NO_READOUTS = ("loss", "matrix")
"""Names in the place of a readout's: of losses, and of the sampling matrix."""


class MetricName(NamedTuple):
    """The parts of a test metric's name.

    Attributes:
        m: the size; None if the run tests one size only.
        readout: of the tested sampler, a baseline's name, or ``full``.
        metric: such as ``accuracy``.
    """

    m: int | None
    readout: str
    metric: str


def size_prefix(m: int | None) -> str:
    """Return ``m32/`` for 32, and an empty string for None."""
    if m is None:
        return ""
    return f"m{m}/"


def parse_metric_name(name: str) -> MetricName | None:
    """Split a name such as ``test/m32/generated/accuracy`` or ``test/generated/accuracy``.

    Returns:
        None for names of another stage, of losses and of the sampling matrix.
    """
    first, *parts = name.split("/")
    m = None
    if len(parts) == 3 and _is_size(parts[0]):
        m = int(parts[0][1:])
        parts = parts[1:]
    if first != "test" or len(parts) != 2:
        return None
    readout, metric = parts
    if readout in NO_READOUTS:
        return None
    return MetricName(m, readout, metric)


def _is_size(part: str) -> bool:
    return part.startswith("m") and part[1:].isdecimal()
