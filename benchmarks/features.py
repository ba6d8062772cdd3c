"""Benchmark of EdgeConv features beside pointwise ones."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from cases import Row, cloud, seconds
from measure import interleaved, peak_memory
from torch import Tensor

from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.edges import EXTRACTORS
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.snet import SNet

SAMPLERS: dict[str, Callable[..., Sampler]] = {
    "mops, m=16": partial(MOPSNet, 16),
    "fmops, m_max=512": partial(FMOPSNet, 512),
    "snet, m=16": partial(SNet, 16),
}
CLOUDS = 32


def build(name: str, features: str) -> Sampler:
    """Return a sampler with random weights."""
    settings: dict[str, Any] = {"features": features}
    return SAMPLERS[name](**settings)


@torch.no_grad()
def sample(sampler: Sampler, points: Tensor) -> Tensor:
    """Return the largest sample in evaluation."""
    return sampler.eval()(points).points


def learn(sampler: Sampler, points: Tensor) -> None:
    """Compute the gradients of a training step under the sampler's own losses."""
    sampler.train().zero_grad()
    outputs = sampler.sample_sizes(points, sampler.training_sizes()).values()
    losses = [loss for output in outputs for loss in output.losses.values()]
    torch.stack([*losses, *(output.points.square().mean() for output in outputs)]).sum().backward()


def features(_peak: dict[str, float], rounds: int) -> list[Row]:
    """Time and memory per cloud of samplers, by their features.

    1,024 points in batches of 32; ``sample`` in evaluation, ``learn`` with all gradients.
    """
    points = cloud(1024, CLOUDS)
    kinds = [(name, extractor) for name in SAMPLERS for extractor in EXTRACTORS]
    rows: list[Row] = []
    for step in (sample, learn):
        calls = {f"{kind}": partial(step, build(*kind), points) for kind in kinds}
        for kind, timing in zip(kinds, interleaved(calls, rounds).values(), strict=True):
            setup = (
                f"from features import *\nsampler, points = build(*{kind}), cloud(1024, {CLOUDS})"
            )
            memory, _ = peak_memory(setup, f"{step.__name__}(sampler, points)")
            row = {"sampler": kind[0], "features": kind[1], "step": step.__name__}
            rows.append({**row, **seconds(timing, CLOUDS), "peak_bytes": memory / CLOUDS})
    return rows
