"""Benchmark of EdgeConv features beside pointwise ones."""

from collections.abc import Callable
from functools import partial

import torch
from cases import Row
from steps import by_step
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


def build(sampler: str, features: str) -> Sampler:
    """Return a sampler with random weights."""
    return SAMPLERS[sampler](features=features)


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
    kinds = [
        {"sampler": name, "features": extractor} for name in SAMPLERS for extractor in EXTRACTORS
    ]
    return by_step(build, kinds, (sample, learn), rounds)
