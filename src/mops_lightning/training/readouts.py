"""Readouts: the point sets that a user may take as the sampled set."""

from collections.abc import Mapping

from torch import Tensor

from mops_lightning.ops.points import gather_points
from mops_lightning.ops.readout import complete, match
from mops_lightning.records.readout_names import FULL, GENERATED_READOUTS, INDEX_READOUT
from mops_lightning.samplers.base import Sampler
from mops_lightning.types import SampleOutput


def readout_names(sampler: Sampler | None) -> tuple[str, ...]:
    """Return the names of a sampler's readouts; without a sampler only the full cloud is scored."""
    if sampler is None:
        return (FULL,)
    return GENERATED_READOUTS if sampler.generates else (INDEX_READOUT,)


def readouts(
    points: Tensor, outputs: Mapping[int, SampleOutput], sampler: Sampler | None
) -> dict[int, dict[str, Tensor]]:
    """Return every readout at every size.

    Args:
        points: ``(B, N, 3)`` the clouds.
        outputs: what ``sampler.sample_sizes`` returned for them, by size.
        sampler: says whether it generates points and whether its sizes are nested; None for
            outputs that are the clouds themselves.

    Returns:
        By size m, then by readout, the points ``(B, m, 3)``: ``generated``, ``matched`` and
        ``completed`` of a sampler that generates points, ``sampled`` of one that selects them,
        ``full`` without a sampler.
    """
    if sampler is None or not sampler.generates:
        (name,) = readout_names(sampler)
        return {m: {name: output.points} for m, output in outputs.items()}
    found = {}
    # Points are matched one by one, so matching the largest nested set matches all smaller ones.
    largest = match(outputs[max(outputs)].points, points) if sampler.nested else None
    for m, output in outputs.items():
        matched = match(output.points, points) if largest is None else largest[:, :m]
        chosen = (matched, complete(matched, points))
        sets = (output.points, *(gather_points(points, rows) for rows in chosen))
        found[m] = dict(zip(GENERATED_READOUTS, sets, strict=True))
    return found
