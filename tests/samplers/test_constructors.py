"""The samplers' constructors: documented defaults, limits of arguments, and sizes."""

from inspect import Parameter, signature
from math import inf, nan
from typing import Any

import numpy as np
import pytest
from hydra.utils import get_class

from mops_lightning import (
    FMOPSNet,
    FPSSampler,
    GumbelSampler,
    MOPSNet,
    ProgressiveSampleNet,
    SampleNet,
    Sampler,
    SNet,
)
from mops_lightning.config.compose import compose
from mops_lightning.config.groups import conf_dir
from mops_lightning.errors import UserError
from mops_lightning.zoo.load import package_samplers

FILES = [
    path for path in sorted(conf_dir().joinpath("sampler").glob("*.yaml")) if path.stem != "own"
]
OTHERS = {"net", "size_sampling", "coverage", "coverage_per_point", "point_channels", "channels"}
"""Arguments whose default differs from a sampler's file, or that the data or the host net set."""
LIMITS: list[tuple[type[Sampler], dict[str, Any]]] = [
    (FPSSampler, {"start": 0}),
    (FPSSampler, {"start": 59}),
    (GumbelSampler, {"tau_min": 1.0}),
    (MOPSNet, {"alpha": 0.0, "tau_min": 1.0, "threshold": 0.0}),
    (FMOPSNet, {"num_sizes": 1, "min_size": 1}),
    (SNet, {"alpha": 0.0, "coverage": 0.0, "coverage_per_point": 0.0}),
    (SampleNet, {"k": 1, "beta": 0.0, "gamma": 0.0, "sigma_min": 0.0}),
    (SampleNet, {"k": 60}),
    (MOPSNet, {"anchor_width": 0.5}),
    (MOPSNet, {"anchors": "fps", "anchor_width": 100.0}),
    (ProgressiveSampleNet, {"min_size": 1}),
]
"""The smallest and largest allowed arguments."""
START = "start must be at least 0, farthest, or null.* got"
STARTS: tuple[Any, ...] = (-1, "nearest", "", True, 1.0, [0], np.array([1, 2]))
WIDTH = "anchor_width must be above 0 and at most 100, got"
WIDTHS = (0.0, -1.0, nan, 100.5, 1e30)
INVALID: list[tuple[type[Sampler], dict[str, Any], str]] = [
    *((FPSSampler, {"start": start}, START) for start in STARTS),
    (MOPSNet, {"tau_min": 0.0}, "tau_min must be above 0 and at most 1, got 0.0"),
    (MOPSNet, {"tau_min": 1.5}, "tau_min must be above 0 and at most 1, got 1.5"),
    (MOPSNet, {"feature_channels": ()}, "feature_channels must be sizes of at least 1 layer,"),
    (MOPSNet, {"rho_channels": (8, 0)}, "rho_channels must be sizes"),
    (MOPSNet, {"overlap": -1.0}, "overlap must be at least 0, got -1.0"),
    (MOPSNet, {"overlap": nan}, "overlap must be at least 0, got nan"),
    (MOPSNet, {"threshold": 1.0}, "threshold must be at least 0 and below 1, got 1.0"),
    (MOPSNet, {"alpha": -1.0}, "alpha must be at least 0, got -1.0"),
    (MOPSNet, {"alpha": inf}, "alpha must be at least 0, got inf"),
    (MOPSNet, {"anchors": "voxel"}, "anchors must be fps, framed or null, got 'voxel'"),
    *((MOPSNet, {"anchors": "fps", "anchor_width": width}, WIDTH) for width in WIDTHS),
    (MOPSNet, {"anchor_width": 0.3}, "anchor_width has no effect without anchors=fps"),
    (FMOPSNet, {"size_sampling": "nestd"}, "size_sampling: unknown 'nestd'.*nested"),
    (FMOPSNet, {"num_sizes": 0}, "num_sizes must be at least 1, got 0"),
    (FMOPSNet, {"min_size": 0}, "min_size must be at least 1, got 0"),
    (FMOPSNet, {"tau_min": 0.0}, "tau_min must"),
    (GumbelSampler, {"tau_min": 0}, "tau_min must be above 0 and at most 1, got 0"),
    (GumbelSampler, {"tau_min": 1.5}, "tau_min must be above 0 and at most 1, got 1.5"),
    (GumbelSampler, {"feature_channels": ()}, "feature_channels must be sizes"),
    (SNet, {"alpha": -1.0}, "alpha must be at least 0, got -1.0"),
    (SNet, {"alpha": nan}, "alpha must be at least 0, got nan"),
    (SNet, {"coverage": -1.0}, "coverage must be at least 0"),
    (SNet, {"feature_channels": (8,)}, "feature_channels must be sizes of at least 2 layers"),
    (SNet, {"head_channels": (0,)}, "head_channels must be .* each at least 1, got .0."),
    (SampleNet, {"k": 0}, "k must be .*at least"),
    (SampleNet, {"beta": -1.0}, "beta must be .*at least"),
    (SampleNet, {"beta": nan}, "beta must be .*at least"),
    (SampleNet, {"gamma": -1.0}, "gamma must be .*at least"),
    (SampleNet, {"sigma_min": -1}, "sigma_min must be .*at least"),
    (ProgressiveSampleNet, {"min_size": 0}, "min_size must be at least 1, got 0"),
    (ProgressiveSampleNet, {"size_reduction": "summ"}, "size_reduction: unknown 'summ'.*sum"),
]
"""Arguments outside of these limits, and the errors."""
WORDS = ("any_unit", "flexible", "generates", "nested", "projects", "spreads")
DECLARED = """
CovarianceSampler: flexible nested
CriticalSampler: flexible nested spreads
FMOPSNet: flexible generates nested spreads
FPSSampler: any_unit flexible nested spreads
GumbelSampler: generates spreads
InformationSampler: flexible nested
MOPSNet: generates spreads
NormalSpaceSampler: flexible nested
PoissonSampler: any_unit flexible spreads
PoseSampler: flexible nested
ProgressiveSampleNet: flexible generates nested projects spreads
RandomSampler: any_unit flexible nested
SNet: generates spreads
SampleNet: generates projects spreads
SerialSampler: any_unit flexible
StageMOPSNet: flexible generates nested spreads
SteadySampler: flexible nested
VoxelSampler: flexible spreads
"""
"""What ``Sampler`` says of each; of samplers that do not spread points, tiles are not thinned."""


def accepting_classes(cls):
    """Return the classes whose arguments a constructor takes: up to the first without ``**``."""
    classes = []
    for base in cls.__mro__:
        classes.append(base)
        kinds = {argument.kind for argument in signature(base.__init__).parameters.values()}
        if Parameter.VAR_KEYWORD not in kinds:
            break
    return classes


@pytest.mark.parametrize("name", [path.stem for path in FILES])
def test_constructor_has_the_defaults_of_its_file(name):
    node = compose([f"sampler={name}", "recipe=paper"]).sampler
    defaults: dict[str, Any] = {}
    for cls in reversed(accepting_classes(get_class(node._target_))):
        if issubclass(cls, Sampler):
            for argument in signature(cls.__init__).parameters.values():
                if argument.default is not Parameter.empty:
                    defaults[argument.name] = argument.default
    for name_of_argument in defaults.keys() - OTHERS:
        default = defaults[name_of_argument]
        if isinstance(default, tuple):
            default = list(default)
        assert node[name_of_argument] == default


@pytest.mark.parametrize("sampler", package_samplers())
def test_sampler_declares_what_it_does(sampler):
    declared = {name for name in WORDS if getattr(sampler, name)}

    assert f"{sampler.__name__}: {' '.join(sorted(declared))}" in DECLARED.splitlines()


@pytest.mark.parametrize(("sampler", "arguments"), LIMITS)
def test_constructor_accepts_limits(sampler, arguments, randn):
    made = sampler(8, **arguments).train()
    clouds = randn(3, 60, 3)

    output = made(clouds)

    assert output.points.shape == (3, 8, 3)


@pytest.mark.parametrize(("sampler", "arguments", "message"), INVALID)
def test_constructor_names_the_argument_outside_of_its_limits(sampler, arguments, message):
    with pytest.raises(UserError, match=f"^{message}"):
        sampler(8, **arguments)
