"""The files of sweeps, also of the rivals: each composes, and names every cell apart."""

import json
import pickle
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

import mops_lightning.config.compose  # noqa: F401  registers the resolvers
from hydra_plugins.grid_sweeper import parsed
from mops_lightning.config import settings
from mops_lightning.config.declaration import Affects
from mops_lightning.config.groups import conf_dir, sweeps_dir
from mops_lightning.config.validate import check
from mops_lightning.tree import dotted

CHECKOUT = Path(__file__).parents[2]
FOLDERS = {
    path.stem: path.parent
    for folder in (CHECKOUT / "sweeps", CHECKOUT / "benchmarks" / "rivals" / "conf")
    for path in folder.glob("*.yaml")
}
"""The folder of every sweep, by its name."""
SWEEPS = sorted(FOLDERS)
ON_SHAPES = ("ablation", "segmentation")
"""Sweeps that use the procedural shapes without the overlay."""
TESTS_ONLY = ("noise", "corruptions")
"""Sweeps that test a trained run."""
ON_FILES = ("las_segmentation",)
"""Sweeps whose settings of the data mean nothing for shapes."""
PLACES = ("sampler", "task.net.sampler", "dataset")
CELLS = {
    "modelnet40": 49,
    "modelnet40_trials": 65,
    "ablation": 18,
    "segmentation": 23,
    "registration": 23,
    "hierarchical": 24,
}


@cache
def composed_once(name, overrides):
    path = [f"hydra.searchpath=[file://{conf_dir()},file://{sweeps_dir()}]"]
    with initialize_config_dir(str(FOLDERS[name]), version_base="1.3"):
        return pickle.dumps(compose(name, [*path, *overrides], return_hydra_config=True))


def composed(name, overrides=()):
    cfg = pickle.loads(composed_once(name, tuple(overrides)))
    HydraConfig.instance().set_config(cfg)
    return cfg


def grids(cfg):
    """Return the overrides of every grid of a sweep."""
    sweeper: Any = OmegaConf.to_container(cfg.hydra.sweeper, resolve=False)
    several = sweeper.get("grids", [{}])
    return [parsed({**(sweeper["params"] or {}), **grid}, "grids") for grid in several]


def checked(cfg):
    if OmegaConf.is_missing(cfg.dataset, "root"):
        cfg.dataset.root = "the user's"
    check(OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"]))


@pytest.mark.parametrize("name", SWEEPS)
def test_sweep_cells_are_valid_and_named_by_swept_settings(name):
    cfg = composed(name)

    raw: Any = OmegaConf.to_container(cfg.hydra.sweep, resolve=False)
    subdir = raw["subdir"]
    names_all = "run_label" in subdir or "override_dirname" in subdir
    for grid in grids(cfg):
        for override in grid:
            key = override.get_key_element()
            known_as = "sampler_label" if key == "sampler" else key
            assert names_all or known_as in subdir or not override.is_sweep_override()
    assert "${" not in f"{cfg.hydra.sweep.dir}/{cfg.hydra.sweep.subdir}"
    assert cfg.hydra.mode.name == "MULTIRUN"
    is_on_shapes = name in (*ON_SHAPES, *TESTS_ONLY)
    assert (cfg.names.dataset == "shapes") == is_on_shapes
    checked(cfg)


TAKES_QUICK = sorted({*SWEEPS} - {*ON_SHAPES, *TESTS_ONLY, *ON_FILES})


@pytest.mark.parametrize("name", TAKES_QUICK)
def test_quick_overlay_runs_any_sweep_on_shapes(name):
    full = composed(name)
    quick = composed(name, ["+quick=shapes", "dataset=shapes"])

    assert quick.hydra.sweep.dir.endswith(f"/sweeps/quick/{name}")
    assert quick.names.dataset == "shapes"
    assert quick.names.recipe == "fast"
    assert quick.dataset.n_points == 512
    assert quick.trainer.max_epochs < full.trainer.max_epochs
    for choice in ("task", "net", "sampler"):
        assert quick.names[choice] == full.names[choice]
    assert quick.hydra.sweeper == full.hydra.sweeper
    as_long = OmegaConf.merge(quick, {"epochs": full.epochs})
    assert as_long.hydra.sweep.subdir == full.hydra.sweep.subdir
    assert as_long.trainer.max_epochs <= 10
    checked(quick)


def different_settings(name, overrides, others):
    """Return the paths of settings that differ between two cells of a sweep."""
    first = settings_of(name, written_out(overrides))
    second = settings_of(name, written_out(others))
    different = set()
    for path in {*first, *second}:
        if first.get(path) != second.get(path):
            different.add(path)
    return different


def written_out(overrides):
    return tuple(f"{key}={value}" for key, value in overrides.items())


def may_follow(path, key):
    """Return whether a setting may differ where another one is swept."""
    followers = {"m": PLACES[:2], "seed": PLACES}.get(key, ())
    if path in [f"{place}.{key}" for place in followers]:
        return True
    if key == "seed" and path == "weights":  # a task net of every seed
        return True
    if key == "sampler":  # a sampler may have an optimizer of its own
        return path.startswith(("sampler.", "optimizer.", "names.sampler"))
    if "@" in key:
        return path.startswith((key.split("@")[-1], "names.stages"))
    return path.startswith(key)


@pytest.mark.parametrize("name", SWEEPS)
def test_sweep_neighbours_differ_in_what_is_swept(name):
    for grid in grids(composed(name)):
        values = {override.get_key_element(): texts(override) for override in grid}
        first = {key: choices[0] for key, choices in values.items()}
        for key, choices in values.items():
            if len(choices) < 2:
                continue
            neighbour = {**first, key: choices[1]}
            for path in different_settings(name, first, neighbour):
                assert may_follow(path, key), path


@pytest.mark.parametrize(("name", "number"), CELLS.items())
def test_cells_of_several_grids_have_folders_of_their_own(name, number):
    folders = []
    for grid in grids(composed(name)):
        (cells,) = BasicSweeper.split_arguments(grid, None)
        for cell in cells:
            folders.append(composed(name, cell).hydra.sweep.subdir)

    assert len(folders) == number
    assert len(set(folders)) == number


def texts(override):
    """Return the values of an override as they are written."""
    if override.is_sweep_override():
        return list(override.sweep_string_iterator())
    return [override.get_value_element_as_str()]


@cache
def settings_of(name, overrides):
    cfg = composed(name, overrides)
    plain = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
    return dotted(OmegaConf.to_container(plain, resolve=True))


COMMITTED = {
    "ablation": "ablation_shapes",
    "ablation_airplanes": "ablation",
    "classification_joint": "classification_joint",
    "classification_joint_dgcnn": "classification_joint/dgcnn",
    "las_segmentation": "las_segmentation",
    "modelnet40": "modelnet40",
    "modelnet40_trials": "modelnet40_nets/trials",
    "registration": "registration/sweep",
    "scans_of_shapes": "scans_of_shapes",
    "segmentation": "segmentation",
    "transfer": "transfer/modelnet40",
}
"""Sweeps, and the folders in results/ with the records of their cells."""

OF_THE_PLACE = ("dataset.root", "trainer.precision", "weights", "other_nets", "recipe.warm_start")
"""Settings that were given on the command line, or name files of a sweep's folder."""


def committed_settings(name):
    """Return the settings of a sweep's committed cells, by their folders in the sweep."""
    path = CHECKOUT / "results" / COMMITTED[name] / "runs.jsonl"
    cells = {}
    for line in path.read_text().splitlines():
        record = json.loads(line)
        folder = record["folder"].rpartition("/")[2]
        cells[folder] = dotted(record["config"])
    return cells


def first_cells(name):
    """Return the overrides of the first cell of every grid."""
    cells = []
    for grid in grids(composed(name)):
        first = {override.get_key_element(): texts(override)[0] for override in grid}
        cells.append(written_out(first))
    return cells


def all_cells(name):
    """Return the overrides of every cell."""
    cells = []
    for grid in grids(composed(name)):
        (of_grid,) = BasicSweeper.split_arguments(grid, None)
        cells += [tuple(cell) for cell in of_grid]
    return cells


@pytest.mark.parametrize("name", COMMITTED)
def test_cells_of_a_sweep_have_the_settings_of_their_committed_records(name):
    """What a result is affected by, of those settings that both versions of the program have."""
    committed = committed_settings(name)
    cells = first_cells(name)
    if name in CELLS:
        cells = all_cells(name)

    found = 0
    for cell in cells:
        cfg = composed(name, cell)
        recorded = committed.get(cfg.hydra.sweep.subdir)
        if recorded is None:
            continue
        found += 1
        present = settings_of(name, cell)
        for path in present.keys() & recorded.keys():
            affects = settings.of(path).affects is not Affects.NOTHING
            if affects and path not in OF_THE_PLACE:
                assert present[path] == recorded[path], (cell, path)

    assert found >= 2
