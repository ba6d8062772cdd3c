"""Readouts: the point sets that a user may take as the sampled set."""

from collections.abc import Mapping

from torch import Tensor

from mops_lightning.ops.points import gather_points
from mops_lightning.ops.readout import complete, match
from mops_lightning.records.readout_names import (
    COMPLETED,
    FULL,
    GENERATED,
    GENERATED_READOUTS,
    INDEX_READOUT,
    MATCHED,
    PROJECTED,
)
from mops_lightning.samplers.base import Sampler
from mops_lightning.types import SampleOutput


def names_of_readouts(sampler: Sampler | None) -> tuple[str, ...]:
    """Return the names of a sampler's readouts; without a sampler only the full cloud is scored."""
    if sampler is None:
        return (FULL,)
    if not sampler.generates:
        return (INDEX_READOUT,)
    if sampler.projects:
        return (*GENERATED_READOUTS, PROJECTED)
    return GENERATED_READOUTS


def readouts(
    points: Tensor, outputs: Mapping[int, SampleOutput], sampler: Sampler | None
) -> dict[int, dict[str, Tensor]]:
    """Return every readout at every size.

    Args:
        points: ``(B, N, 3)`` the clouds.
        outputs: what ``sampler.sample_sizes`` returned for them, by size.
        sampler: says which readouts there are and whether its sizes are nested; None for outputs
            that are the clouds themselves.

    Returns:
        By size m, then by readout in the order of ``names_of_readouts``, the points ``(B, m, 3)``:
        ``generated``, ``matched`` and ``completed`` of a sampler that generates points, with
        ``projected`` of one that projects them; ``sampled`` of one that selects points; ``full``
        without a sampler.
    """
    if sampler is None or not sampler.generates:
        (name,) = names_of_readouts(sampler)
        return {m: {name: output.points} for m, output in outputs.items()}
    if sampler.nested:
        return _nested_readouts(points, outputs, sampler)
    samples = {}
    for m, output in outputs.items():
        samples[m] = _generated_readouts(points, output.points, sampler)
    return samples


def _nested_readouts(
    points: Tensor, outputs: Mapping[int, SampleOutput], sampler: Sampler
) -> dict[int, dict[str, Tensor]]:
    """Return the readouts of nested samples.

    Points are matched and projected one by one, so those of the largest sample serve all sizes.
    """
    generated = outputs[max(outputs)].points
    rows = match(generated, points)
    by_size = {}
    for m, output in outputs.items():
        by_size[m] = _readouts_of(points, output.points, rows[:, :m])
    if sampler.projects:
        projected = sampler.project(generated, points)
        for m, sets in by_size.items():
            sets[PROJECTED] = projected[:, :m]
    return by_size


def _generated_readouts(points: Tensor, generated: Tensor, sampler: Sampler) -> dict[str, Tensor]:
    """Return the readouts of one sample ``(B, m, 3)``."""
    sets = _readouts_of(points, generated, match(generated, points))
    if sampler.projects:
        sets[PROJECTED] = sampler.project(generated, points)
    return sets


def _readouts_of(points: Tensor, generated: Tensor, rows: Tensor) -> dict[str, Tensor]:
    """Return the generated points, and the matched and completed ones.

    Args:
        points: ``(B, N, 3)`` the clouds.
        generated: ``(B, m, 3)``.
        rows: ``(B, m)`` of the matched points.
    """
    return {
        GENERATED: generated,
        MATCHED: gather_points(points, rows),
        COMPLETED: gather_points(points, complete(rows, points)),
    }
