"""A small sampler of every kind. A new sampler adds one line to SAMPLERS."""

from collections.abc import Callable
from typing import Any

import torch

from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.covariance import CovarianceSampler
from mops_lightning.samplers.critical_points import CriticalSampler
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.gumbel import GumbelSampler
from mops_lightning.samplers.information import InformationSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.normal_space import NormalSpaceSampler
from mops_lightning.samplers.poisson import PoissonSampler
from mops_lightning.samplers.pose import PoseSampler
from mops_lightning.samplers.random import RandomSampler
from mops_lightning.samplers.samplenet import ProgressiveSampleNet, SampleNet
from mops_lightning.samplers.serial import SerialSampler
from mops_lightning.samplers.snet import SNet
from mops_lightning.samplers.steady import SteadySampler
from mops_lightning.samplers.voxel import VoxelSampler

FEATURES: dict[str, Any] = {"feature_channels": (8, 6)}
SMALL: dict[str, Any] = {**FEATURES, "head_channels": (12, 10)}
MOPS_LAYERS: dict[str, Any] = {**FEATURES, "rho_channels": (12, 10)}
ANCHORED: dict[str, Any] = {**MOPS_LAYERS, "anchors": "fps"}
LOCAL: dict[str, Any] = {**ANCHORED, "candidates": 2, "neighbours": 3}


def moved(sampler: MOPSNet) -> MOPSNet:
    """Give a sampler with anchors weights that differ from those of its start."""
    for weights in sampler.queries.parameters():
        values = torch.arange(weights.numel()).sin() / 2
        weights.data = values.reshape(weights.shape)
    return sampler


SAMPLERS: dict[str, Callable[..., Sampler]] = {
    "random": RandomSampler,
    "fps": FPSSampler,
    "voxel": VoxelSampler,
    "poisson": PoissonSampler,
    "serial": SerialSampler,
    "normal_space": NormalSpaceSampler,
    "covariance": CovarianceSampler,
    "information": InformationSampler,
    "steady": SteadySampler,
    "pose": lambda m: PoseSampler(m, head_channels=(5,), **FEATURES),
    "critical": lambda m, **kw: CriticalSampler(m, PointNetVanilla(3), **kw),
    "gumbel": lambda m: GumbelSampler(m, **FEATURES),
    "mops": lambda m: MOPSNet(m, **MOPS_LAYERS),
    "fmops": lambda m: FMOPSNet(m, **MOPS_LAYERS),
    "mops-anchors": lambda m: moved(MOPSNet(m, **ANCHORED)),
    "fmops-anchors": lambda m: moved(FMOPSNet(m, **ANCHORED)),
    "fmops-framed": lambda m: moved(FMOPSNet(m, anchors="framed", **MOPS_LAYERS)),
    "mops-local": lambda m: moved(MOPSNet(m, **LOCAL)),
    "fmops-local": lambda m: moved(FMOPSNet(m, **LOCAL)),
    "snet": lambda m: SNet(m, **SMALL),
    "snet-without-norm": lambda m: SNet(m, head_norm=False, output_norm=False, **SMALL),
    "samplenet": lambda m: SampleNet(m, k=3, **SMALL),
    "samplenet-progressive": lambda m: ProgressiveSampleNet(m, k=3, **SMALL),
}
