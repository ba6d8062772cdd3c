"""The samplers' constructors: documented defaults, limits of arguments, and sizes."""

from inspect import Parameter, signature
from typing import Any

import pytest
import torch
from hydra.utils import get_class

from mops_lightning.config.compose import compose, conf_dir
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.gumbel import GumbelSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.poisson import PoissonSampler
from mops_lightning.samplers.samplenet import ProgressiveSampleNet, SampleNet
from mops_lightning.samplers.serial import SerialSampler
from mops_lightning.samplers.snet import SNet
from mops_lightning.samplers.voxel import VoxelSampler
from mops_lightning.zoo.load import package_samplers

FILES = [
    path for path in sorted(conf_dir().joinpath("sampler").glob("*.yaml")) if path.stem != "own"
]
OTHERS = {"net", "size_sampling", "coverage", "coverage_per_point"}
"""Arguments of which some sampler's file sets another value than the default."""
LIMITS: list[tuple[type[Sampler], dict[str, Any]]] = [
    (FPSSampler, {"start": 0}),
    (FPSSampler, {"start": 59}),
    (GumbelSampler, {"tau_min": 1.0}),
    (MOPSNet, {"alpha": 0.0, "tau_min": 1.0, "threshold": 0.0}),
    (FMOPSNet, {"num_sizes": 1, "min_size": 1}),
    (SNet, {"alpha": 0.0, "coverage": 0.0, "coverage_per_point": 0.0}),
    (SampleNet, {"k": 1, "beta": 0.0, "gamma": 0.0, "sigma_min": 0.0}),
    (SampleNet, {"k": 60}),
    (ProgressiveSampleNet, {"min_size": 1}),
]
"""The smallest and largest allowed arguments."""
NOT_FLEXIBLE = (GumbelSampler, MOPSNet, SNet, SampleNet)
FLEXIBLE_NOT_NESTED = (VoxelSampler, PoissonSampler, SerialSampler)


@pytest.mark.parametrize("name", [path.stem for path in FILES if path.stem != "own"])
def test_constructor_has_the_defaults_of_its_file(name):
    node = compose([f"sampler={name}", "recipe=paper"]).sampler
    defaults: dict[str, Any] = {}
    for cls in reversed(get_class(node._target_).__mro__):
        if issubclass(cls, Sampler):
            arguments = signature(cls.__init__).parameters.values()
            defaults |= {a.name: a.default for a in arguments if a.default is not Parameter.empty}
    for argument in defaults.keys() - OTHERS:
        default = defaults[argument]
        assert node[argument] == (list(default) if isinstance(default, tuple) else default)


@pytest.mark.parametrize("sampler", package_samplers())
def test_sampler_declares_sizes(sampler):
    assert sampler.flexible == (sampler not in NOT_FLEXIBLE)
    assert sampler.nested == (sampler not in (*NOT_FLEXIBLE, *FLEXIBLE_NOT_NESTED))


@pytest.mark.parametrize(("sampler", "arguments"), LIMITS)
def test_constructor_accepts_limits(sampler, arguments, rng):
    made = sampler(8, **arguments)
    clouds = torch.randn(3, 60, 3, generator=rng)
    assert made.train()(clouds).points.shape == (3, 8, 3)
