"""The readouts of a batch: what a user may take as the sampled set."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from mops_lightning.ops.points import gather_points
from mops_lightning.ops.readout import complete, match
from mops_lightning.records.readout_names import FULL, GENERATED_READOUTS, INDEX_READOUT
from mops_lightning.samplers.base import Sampler
from mops_lightning.tasks.base import Sample
from mops_lightning.types import SampleOutput


def full_cloud(points: Tensor) -> SampleOutput:
    """Keep every point."""
    return SampleOutput(points, None, {})


def readout_names(sampler: Sampler | None) -> tuple[str, ...]:
    """Name the readouts of a sampler; without one only the full cloud is left."""
    if sampler is None:
        return (FULL,)
    return GENERATED_READOUTS if sampler.generates else (INDEX_READOUT,)


class BatchReadouts:
    """Gives every readout of one batch at every size as a sample function.

    A sampler runs once per tensor and, if it is nested, once for all sizes.

    Args:
        sampler: the sampler under test or in training, or None.
        baselines: further index samplers, by name; each is a readout of its own.
        sizes: how many points will be asked for.
    """

    def __init__(
        self, sampler: Sampler | None, baselines: Mapping[str, Sampler], sizes: Sequence[int]
    ) -> None:
        self.samplers = dict(baselines)
        if sampler is not None:
            self.samplers["own"] = sampler
        self.sizes = sizes
        # Keyed by id; the tensor is kept beside its output, so that no id is used twice.
        self._outputs: dict[tuple[str, int], tuple[Tensor, dict[int, SampleOutput]]] = {}
        self._matches: dict[tuple[int, int], Tensor] = {}

    def sample_as(self, readout: str, m: int) -> Sample:
        """Return the function from ``(B, N, 3)`` points to this readout of them at size m."""
        if readout == FULL:
            return full_cloud
        if readout in ("generated", INDEX_READOUT):
            return lambda points: self._once("own", points)[m]
        if readout == "matched":
            return lambda points: _chosen(points, self._indices(points, m))
        if readout == "completed":
            return lambda points: _chosen(points, complete(self._indices(points, m), points))
        return lambda points: self._once(readout, points)[m]

    def as_trained_on(self, m: int) -> Sample:
        """Return the function to what the task net sees in training at size m."""

        def sample(points: Tensor) -> SampleOutput:
            output = self._once("own", points)[m]
            soft = output.soft_projected
            return output if soft is None else output._replace(points=soft)

        return sample

    def outputs(self, m: int) -> list[tuple[Tensor, SampleOutput]]:
        """Return what the sampler has made so far at size m, beside the points it was made of."""
        return [
            (points, sizes[m])
            for (name, _), (points, sizes) in self._outputs.items()
            if name == "own"
        ]

    def wholes(self) -> list[tuple[Tensor, SampleOutput, Sequence[int]]]:
        """Return what the sampler has made so far: points, output, the sizes that it stands for."""
        found: list[tuple[Tensor, SampleOutput, Sequence[int]]] = []
        for (name, _), (points, outputs) in self._outputs.items():
            if name != "own":
                continue
            if self.samplers[name].nested:
                found.append((points, outputs[max(self.sizes)], self.sizes))
            else:
                found += [(points, outputs[m], (m,)) for m in self.sizes]
        return found

    def _once(self, name: str, points: Tensor) -> dict[int, SampleOutput]:
        key = (name, id(points))
        if key not in self._outputs:
            self._outputs[key] = (points, self.samplers[name].sample_sizes(points, self.sizes))
        return self._outputs[key][1]

    @torch.no_grad()
    def _indices(self, points: Tensor, m: int) -> Tensor:
        # Each point is matched for itself, so smaller sizes of a nested sampler are matched too.
        source = max(self.sizes) if self.samplers["own"].nested else m
        key = (id(points), source)
        output = self._once("own", points)[source]
        if key not in self._matches:
            self._matches[key] = match(output.points, points)
        return self._matches[key][:, :m]


def _chosen(points: Tensor, indices: Tensor) -> SampleOutput:
    return SampleOutput(gather_points(points, indices), indices, {})
