"""One default for each argument: in its class, and in the file of its group."""

from collections.abc import Iterator
from inspect import isclass, signature
from pathlib import Path
from typing import Any

import hydra.utils
import pytest
from omegaconf import DictConfig, OmegaConf

from mops_lightning.config.compose import compose

CONF = Path(__file__).parents[2] / "conf"

DIFFERENT = {
    "dataset/mesh_sequence.yaml": {"n_points", "gap"},  # of one data set, in a function for several
    "dataset/shapenet_core.yaml": {"test_share"},
    "optimizer/muon.yaml": {"lr"},
    "optimizer/one_cycle_fmops/registration_fast.yaml": {"lr"},
    "sampler/samplenet_progressive.yaml": {"coverage", "coverage_per_point"},  # as published
    "task/net/foldingnet.yaml": {"pieces"},  # MFoldingNet with one piece is FoldingNet
}
"""Files whose values are others than the defaults of the class, on purpose."""


def defaults_of(target: Any) -> dict[str, Any]:
    """Return the defaults of a function, or of a class and its bases."""
    bases = [target]
    if isclass(target):
        bases = [*reversed(target.__mro__)]
    defaults = {}
    for base in bases:
        for name, parameter in signature(base).parameters.items():
            if parameter.default is not parameter.empty:
                defaults[name] = parameter.default
    return defaults


def files_of_our_classes() -> Iterator[tuple[str, DictConfig]]:
    """Yield the files of groups that name a class or function of this package."""
    for path in sorted(CONF.rglob("*.yaml")):
        content = OmegaConf.load(path)
        if not isinstance(content, DictConfig) or OmegaConf.is_missing(content, "_target_"):
            continue
        if str(content.get("_target_")).startswith("mops_lightning."):
            yield path.relative_to(CONF).as_posix(), content


FILES = dict(files_of_our_classes())


@pytest.mark.parametrize("file", FILES)
def test_values_of_a_group_are_the_defaults_of_its_class(file):
    content = FILES[file]
    defaults = defaults_of(hydra.utils.get_object(content["_target_"]))

    different = set()
    for name in map(str, content):
        is_plain = not OmegaConf.is_interpolation(content, name)
        if name not in defaults or not is_plain or OmegaConf.is_missing(content, name):
            continue
        value = content[name]
        if isinstance(value, DictConfig):
            continue
        default = defaults[name]
        if isinstance(default, tuple):
            default = list(default)
        if value != default:
            different.add(name)

    assert different == DIFFERENT.get(file, set())


WHOLE = {"test_frames": None, "crop": "whole", "crops": 1}
SURFACE = {"test_frames": None, "crop": "surface", "crops": 1}

DATA_SETS: dict[str, dict[str, Any]] = {
    "clouds": {
        "root": "???",
        "test_frames": None,
        "crop": "nearest",
        "crops": None,
        "seed": "${seed}",
        "cache": "${cache}/meshes",
    },
    "hdf5": {"root": "???"},
    "mesh_sequence": {
        "root": "???",
        "n_points": 40960,
        **SURFACE,
        "test_frames": "last",
        "gap": 2,
        "seed": "${seed}",
        "cache": "${cache}/meshes",
    },
    "meshes": {"root": "???", **SURFACE, "seed": "${seed}", "cache": "${cache}/meshes"},
    "modelnet40": {"root": "data/modelnet40_ply_hdf5_2048"},
    "scans_of_shapes": {"seed": "${seed}", "cache": "${cache}/shapes"},
    "shapenet_core": {
        "root": "data/shape_net_core_uniform_samples_2048",
        **WHOLE,
        "test_share": 0.15,
        "cache": "${cache}/meshes",
    },
    "shapes": {"seed": "${seed}", "cache": "${cache}/shapes"},
}
"""Values of data sets that are no defaults of their functions, as the files have them."""


@pytest.mark.parametrize("name", DATA_SETS)
def test_data_set_has_the_values_of_its_kind(name):
    content: Any = OmegaConf.to_container(FILES[f"dataset/{name}.yaml"])
    defaults = defaults_of(hydra.utils.get_object(content.pop("_target_")))

    others = {}
    for key, value in content.items():
        if key not in defaults or value != defaults[key]:
            others[key] = value

    assert others == DATA_SETS[name]
    assert {f"dataset/{kind}.yaml" for kind in DATA_SETS} == {
        file for file in FILES if file.startswith("dataset/")
    }


@pytest.mark.parametrize(
    ("dataset", "seed"),
    [
        ("clouds", 7),
        ("mesh_sequence", 7),
        ("meshes", 7),
        ("scans_of_shapes", 7),
        ("shapes", 7),
        ("shapenet_core", 0),  # one split for all seeds
    ],
)
def test_seed_of_a_data_set_is_the_runs_but_for_published_splits(dataset, seed):
    cfg = compose([f"dataset={dataset}", "seed=7"])

    assert cfg.dataset.seed == seed
