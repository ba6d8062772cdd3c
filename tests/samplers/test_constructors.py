"""The samplers' constructors: documented defaults, limits of arguments, and sizes."""

from inspect import Parameter, signature
from typing import Any

import pytest
import torch

from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.critical_points import CriticalSampler
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.gumbel import GumbelSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.poisson import PoissonSampler
from mops_lightning.samplers.random import RandomSampler
from mops_lightning.samplers.samplenet import ProgressiveSampleNet, SampleNet
from mops_lightning.samplers.snet import ProgressiveSNet, SNet
from mops_lightning.samplers.submodular import SubmodularSampler
from mops_lightning.samplers.voxel import VoxelSampler

FEATURES: dict[str, Any] = {"feature_channels": (64, 64, 64, 128, 128)}
MOPS: dict[str, Any] = {
    **{"alpha": 30.0, "tau_min": 0.1, "threshold": 0.0},
    **{"rho_channels": (512, 256, 128), "anchors": None, **FEATURES},
    "anchor_width": 0.5,
    "overlap": 0.0,
}
SNET: dict[str, Any] = {
    **{"alpha": 30.0, "coverage": 1.0, "coverage_per_point": 0.0, **FEATURES},
    **{"head_channels": (256, 256, 256), "head_norm": True, "output_norm": True},
}
DEFAULTS: dict[type[Sampler], dict[str, Any]] = {
    RandomSampler: {"seed": 0},
    FPSSampler: {"seed": 0, "start": None},
    VoxelSampler: {},
    PoissonSampler: {"seed": 0},
    SubmodularSampler: {"net": None, "seed": 0},
    CriticalSampler: {"net": None, "seed": 0},
    GumbelSampler: {"tau_min": 0.1, **FEATURES},
    MOPSNet: MOPS,
    FMOPSNet: {"m_max": 512, "size_sampling": "nested", "num_sizes": 4, "min_size": 1},
    SNet: SNET,
    SampleNet: {"k": 7, "beta": 1.0, "gamma": None, "sigma_min": 0.0},
    ProgressiveSNet: {"m_max": 1024, "min_size": 2, "size_reduction": "sum"},
    ProgressiveSampleNet: {"m_max": 1024, "min_size": 2, "size_reduction": "sum"},
}
"""Of the constructors, as published or documented."""
LIMITS: list[tuple[type[Sampler], dict[str, Any]]] = [
    (FPSSampler, {"start": 0}),
    (FPSSampler, {"start": 59}),
    (GumbelSampler, {"tau_min": 1.0}),
    (MOPSNet, {"alpha": 0.0, "tau_min": 1.0, "threshold": 0.0}),
    (FMOPSNet, {"num_sizes": 1, "min_size": 1}),
    (SNet, {"alpha": 0.0, "coverage": 0.0, "coverage_per_point": 0.0}),
    (SampleNet, {"k": 1, "beta": 0.0, "gamma": 0.0, "sigma_min": 0.0}),
    (SampleNet, {"k": 60}),
    (ProgressiveSNet, {"min_size": 1}),
]
"""The smallest and largest allowed arguments."""
NOT_FLEXIBLE = (GumbelSampler, MOPSNet, SNet, SampleNet)
FLEXIBLE_NOT_NESTED = (VoxelSampler, PoissonSampler)


@pytest.mark.parametrize("sampler", DEFAULTS)
def test_constructor_has_documented_defaults(sampler):
    arguments = signature(sampler.__init__).parameters.values()
    found = {a.name: a.default for a in arguments if a.default is not Parameter.empty}
    assert found == DEFAULTS[sampler]


@pytest.mark.parametrize("sampler", DEFAULTS)
def test_sampler_declares_sizes(sampler):
    assert sampler.flexible == (sampler not in NOT_FLEXIBLE)
    assert sampler.nested == (sampler not in (*NOT_FLEXIBLE, *FLEXIBLE_NOT_NESTED))


@pytest.mark.parametrize(("sampler", "arguments"), LIMITS)
def test_constructor_accepts_limits(sampler, arguments, rng):
    made = sampler(8, **arguments)
    clouds = torch.randn(3, 60, 3, generator=rng)
    assert made.train()(clouds).points.shape == (3, 8, 3)
