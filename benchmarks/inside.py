"""Benchmark of samplers inside the hierarchical net."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from cases import Row, cloud, seconds
from measure import interleaved, peak_memory
from torch import Tensor, nn

from mops_lightning.nets.hierarchical import HierarchicalNet
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.stage import StageMOPSNet

ALL_POINTS = [512, 256, 128, 64]
HALF = [256, 128, 64, 32]
NARROW: dict[str, Any] = {"feature_channels": [32, 32, 64], "rho_channels": [128, 64]}
SAMPLERS: dict[str, Callable[..., nn.Module]] = {
    "fps": FPSSampler,
    "mops": MOPSNet,
    "mops anchored": partial(MOPSNet, anchors="fps"),
    "mops anchored, narrow": partial(MOPSNet, anchors="fps", **NARROW),
    "mops on the stage's features": StageMOPSNet,
}
CLOUDS = 32


def build(name: str, sizes: list[int]) -> HierarchicalNet:
    """Return the net for 40 classes with random weights."""
    return HierarchicalNet(40, SAMPLERS[name], sizes)


@torch.no_grad()
def classify(net: HierarchicalNet, points: Tensor) -> Tensor:
    """Return the net's output in evaluation."""
    return net.eval()(points)


def learn(net: HierarchicalNet, points: Tensor) -> None:
    """Compute the gradients of a training step, with the losses of the stages' samplers."""
    net.train().zero_grad()
    torch.stack([net(points).square().mean(), *net.losses.values()]).sum().backward()


def inside(_peak: dict[str, float], rounds: int) -> list[Row]:
    """Time and memory per cloud of a hierarchical net, by its stages' samplers.

    1,024 points in batches of 32; ``classify`` in evaluation, ``learn`` with all gradients.
    """
    points = cloud(1024, CLOUDS)
    kinds = [("fps", ALL_POINTS), *((name, HALF) for name in SAMPLERS)]
    rows: list[Row] = []
    for step in (classify, learn):
        calls = {f"{kind}": partial(step, build(*kind), points) for kind in kinds}
        for kind, timing in zip(kinds, interleaved(calls, rounds).values(), strict=True):
            setup = f"from inside import *\nnet, points = build(*{kind}), cloud(1024, {CLOUDS})"
            memory, _ = peak_memory(setup, f"{step.__name__}(net, points)")
            row = {"sampler": kind[0], "points": str(kind[1])[1:-1], "step": step.__name__}
            rows.append({**row, **seconds(timing, CLOUDS), "peak_bytes": memory / CLOUDS})
    return rows
