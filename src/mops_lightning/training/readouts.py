"""Readouts: the point sets that a user may take as the sampled set."""

from collections.abc import Mapping

from torch import Tensor

from mops_lightning.ops.points import gather_points
from mops_lightning.ops.readout import complete, match
from mops_lightning.records.readout_names import FULL, GENERATED_READOUTS, INDEX_READOUT
from mops_lightning.samplers.base import Sampler
from mops_lightning.types import SampleOutput


def names_of_readouts(sampler: Sampler | None) -> tuple[str, ...]:
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
    samples: dict[int, dict[str, Tensor]] = {}
    names = names_of_readouts(sampler)
    generates = sampler is not None and sampler.generates
    # Points are matched one by one, so matching the largest nested set matches all smaller ones.
    nested = generates and sampler is not None and sampler.nested
    largest = match(outputs[max(outputs)].points, points) if nested else None
    for m, output in outputs.items():
        sets = [output.points]
        if generates:
            matched = match(output.points, points) if largest is None else largest[:, :m]
            completed = complete(matched, points)
            sets += [gather_points(points, matched), gather_points(points, completed)]
        samples[m] = dict(zip(names, sets, strict=True))
    return samples
