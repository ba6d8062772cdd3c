"""The files below sweeps/: each composes, and names every cell apart."""

from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from hydra_plugins.grid_sweeper import parsed
from mops_lightning.config.hydra_conf import conf_dir
from mops_lightning.config.validate import check
from mops_lightning.records.run_record import dotted

ROOT = Path(__file__).parents[2] / "sweeps"
SWEEPS = sorted(
    str(path.relative_to(ROOT).with_suffix(""))
    for path in ROOT.rglob("*.yaml")
    if path.stem != "minutes"
)


def composed(name, overrides=()):
    path = [f"hydra.searchpath=[file://{conf_dir()}]"]
    with initialize_config_dir(str(ROOT), version_base="1.3"):
        cfg = compose(name, [*path, *overrides], return_hydra_config=True)
    HydraConfig.instance().set_config(cfg)
    return cfg


@pytest.mark.parametrize("name", SWEEPS)
def test_sweep_cells_are_valid_and_named_by_swept_settings(name):
    quick = name.startswith("quick/")
    cfg = composed(name)
    raw: Any = OmegaConf.to_container(cfg.hydra.sweep, resolve=False)
    swept = [key for key, values in cfg.hydra.sweeper.params.items() if "," in str(values)]
    for key in swept:
        known_as = "names.sampler" if key == "sampler" else key
        assert f"${{{known_as}}}" in raw["subdir"], "two cells would share a folder"
    assert "${" not in f"{cfg.hydra.sweep.dir}/{cfg.hydra.sweep.subdir}"
    assert cfg.hydra.mode.name == "MULTIRUN"
    assert ("/sweeps/quick/" in cfg.hydra.sweep.dir) == quick
    assert (cfg.names.dataset == "shapes") == quick or name == "noise"
    assert not quick or cfg.trainer.max_epochs <= 4
    if OmegaConf.is_missing(cfg.dataset, "root"):
        cfg.dataset.root = "the user's"
    check(OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"]))


def test_sweeps_all_have_quick_form():
    full = {name for name in SWEEPS if "/" not in name}
    assert {f"quick/{name}" for name in full - {"noise", "modelnet40"}} == set(SWEEPS) - full


@pytest.mark.parametrize("name", SWEEPS)
def test_sweep_neighbours_differ_in_what_is_swept(name):
    params: Any = OmegaConf.to_container(composed(name).hydra.sweeper.params)
    swept = {key: values.split(",") for key, values in params.items() if "," in str(values)}
    for key, (first, second, *_) in swept.items():
        one, other = (settings_of(composed(name, [f"{key}={value}"])) for value in (first, second))
        different = {path for path in {**one, **other} if one.get(path) != other.get(path)}
        # A sampler may have an optimizer of its own.
        allowed = ("sampler.", "optimizer.", "names.sampler") if key == "sampler" else (key,)
        followers = {f"sampler.{key}"} if key in ("m", "seed") else set()
        followers |= {f"dataset.{key}"} if key == "seed" else set()
        assert not {path for path in different - followers if not path.startswith(allowed)}


def test_planned_cells_have_folders_of_their_own():
    sweeper: Any = OmegaConf.to_container(composed("modelnet40").hydra.sweeper)
    cells = []
    for grid in sweeper["grids"]:
        overrides = parsed({**sweeper["params"], **grid}, "grids")
        cells += BasicSweeper.split_arguments(overrides, None)[0]
    folders = [composed("modelnet40", cell).hydra.sweep.subdir for cell in cells]
    assert len(folders) == 49
    assert len(set(folders)) == len(folders)


def settings_of(cfg):
    plain = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
    return dotted(OmegaConf.to_container(plain, resolve=True))
