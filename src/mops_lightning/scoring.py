"""The readouts of a batch: what a user may take as the sampled set."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from mops_lightning.geometry import gather_points
from mops_lightning.readout import complete, match
from mops_lightning.samplers.base import Sampler
from mops_lightning.types import SampleOutput

Sample = Callable[[Tensor], SampleOutput]

GENERATED_READOUTS = ("generated", "matched", "completed")
"""Straight out of the sampler; nearest input points; these made unique and filled up by FPS."""
INDEX_READOUT = "sampled"
"""Index samplers choose input points, so their three readouts are one."""
FULL = "full"
"""The cloud before sampling: what the task net can do at best."""


def full_cloud(points: Tensor) -> SampleOutput:
    """Keep every point."""
    return SampleOutput(points, None, {})


def readout_names(sampler: Sampler | None) -> tuple[str, ...]:
    """Name the readouts of a sampler; without one only the full cloud is left."""
    if sampler is None:
        return (FULL,)
    return GENERATED_READOUTS if sampler.generates else (INDEX_READOUT,)


class BatchReadouts:
    """Gives every readout of one batch as a sample function; the sampler runs once per tensor.

    Args:
        sampler: the sampler under test, or None.
        baselines: further index samplers, by name; each is a readout of its own.
    """

    def __init__(self, sampler: Sampler | None, baselines: Mapping[str, Sampler]) -> None:
        self.sampler = sampler
        self.baselines = baselines
        # Keyed by id; the tensor is kept beside its output, so that no id is used twice.
        self.outputs: dict[int, tuple[Tensor, SampleOutput]] = {}
        self.matches: dict[int, Tensor] = {}

    def sample_as(self, readout: str) -> Sample:
        """Return the function from ``(B, N, 3)`` points to this readout of them."""
        if readout == FULL:
            return full_cloud
        if readout in self.baselines:
            return self.baselines[readout]
        if readout in ("generated", INDEX_READOUT):
            return self._once
        return self._matched if readout == "matched" else self._completed

    def _once(self, points: Tensor) -> SampleOutput:
        if id(points) not in self.outputs:
            assert self.sampler is not None
            self.outputs[id(points)] = (points, self.sampler(points))
        return self.outputs[id(points)][1]

    @torch.no_grad()
    def _indices(self, points: Tensor) -> Tensor:
        output = self._once(points)
        if id(points) not in self.matches:
            self.matches[id(points)] = match(output.points, points)
        return self.matches[id(points)]

    def _matched(self, points: Tensor) -> SampleOutput:
        indices = self._indices(points)
        return SampleOutput(gather_points(points, indices), indices, {})

    def _completed(self, points: Tensor) -> SampleOutput:
        indices = complete(self._indices(points), points)
        return SampleOutput(gather_points(points, indices), indices, {})
