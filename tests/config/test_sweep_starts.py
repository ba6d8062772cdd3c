"""Every sweep file starts, on small data of the form that it names.

Each cell's objects are built; one cell of each sweep is run.
"""

import re
from typing import Any

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from omegaconf import OmegaConf

from mops_lightning.config.groups import sweeps_dir
from mops_lightning.config.overrides import key as key_of
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.run import run as running
from mops_lightning.training.run.build import build_parts
from tests.config.test_sweeps import FOLDERS, SWEEPS, composed, grids
from tests.support.command_line import call
from tests.support.small_data import write_all

SMALL = [
    "trainer=cpu",
    "trainer.precision=32-true",
    "trainer.max_epochs=1",
    "epochs.task=1",
    "batch_size=4",
    "val_fraction=0",
    "pictures=0",
    "logger=none",
    "weights=null",
]
"""The settings of a cell that ends in a moment."""

FORMS = {
    "classification_large": "meshes",
    "frameworks_10000": "hdf5",
    "reconstruction_scans": "mesh_sequence",
    "ablation": "shapes",
    "segmentation": "shapes",
    "noise": "shapes",
    "corruptions": "shapes",
    "las_segmentation": "airborne",
    "scans_of_shapes": "shapes",
}
"""The data that a sweep reads; the others read ModelNet40."""

SMALLER = {
    "classification_large": ["dataset.n_points=1024"],
    "frameworks_1024": ["task.net.codeword=16", "dataset.n_points=256"],
    "frameworks_10000": ["task.net.codeword=16", "dataset.n_points=256"],
    "reconstruction_scans": [
        "task.net.codeword=16",
        "task.net.pieces=4",
        "dataset.n_points=256",
        "m=32",
    ],
    "ablation": ["dataset.train_per_class=2", "dataset.test_per_class=1"],
    "ablation_airplanes": ["dataset.n_points=256"],
    "hierarchical": ["task.net.points=[64,32,16,8]"],
    "segmentation": ["dataset.train_per_class=2", "dataset.test_per_class=1"],
    "noise": [
        "learn=nothing",
        "sampler=serial",
        "dataset.train_per_class=2",
        "dataset.test_per_class=1",
    ],
    "corruptions": [
        "learn=nothing",
        "sampler=serial",
        "dataset.train_per_class=2",
        "dataset.test_per_class=1",
    ],
    "las_segmentation": ["dataset.n_points=256", "m=16", "task.net.points=[16,8]"],
    "scans_of_shapes": ["dataset.train_per_class=2", "dataset.test_per_class=1"],
    "reconstruction_sizes": ["dataset.n_points=256"],
    "reconstruction_fmops": ["dataset.n_points=256"],
    "registration": ["task.net.feature_channels=[16,32]"],
    "transfer": ["other_nets=null", "recipe.nets_per_step=null"],
}


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    """A folder of each form of data, with a few clouds."""
    top = tmp_path_factory.mktemp("data")
    write_all(top)
    return top


def settings_of(name, roots):
    """Return the settings that make a sweep small, with the data that it reads."""
    form = FORMS.get(name, "modelnet40")
    data = [] if form == "shapes" else [f"dataset.root={roots / form}"]
    if form in ("meshes", "mesh_sequence"):
        data.append(f"dataset.cache={roots}/cache")
    return [*SMALL, *SMALLER.get(name, []), *data]


def without_hydra(cfg):
    plain = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
    plain.names = OmegaConf.to_container(cfg.names, resolve=True)
    return plain


def cells_of(name):
    """Return the cells of a sweep, each as overrides."""
    return [
        cell
        for grid in grids(composed(name))
        for cell in BasicSweeper.split_arguments(grid, None)[0]
    ]


@pytest.mark.parametrize("name", SWEEPS)
def test_sweep_builds_the_parts_of_each_kind_of_cell(name, roots, tmp_path):
    given = settings_of(name, roots)
    fixed = {key_of(argument) for argument in given}
    kinds: dict[tuple[str, ...], list[str]] = {}
    for cell in cells_of(name):
        free = [one for one in cell if key_of(one) not in fixed]
        # Cells that differ in numbers or corruptions only are built from the same classes.
        kind = tuple(one for one in free if not re.search(r"=[-+.e\d]+$|^test_", one))
        kinds.setdefault(kind, free)
    for free in kinds.values():
        cfg = running.checked(without_hydra(composed(name, (*free, *given))), [])
        dataset = running._load_data(cfg)
        settings: Any = OmegaConf.to_container(cfg, resolve=True)
        started = RunRecord.begin(settings, [], seed=0)

        parts = build_parts(cfg, tmp_path, dataset, started)

        assert parts.trainer.max_epochs == 1


@pytest.mark.parametrize("name", SWEEPS)
def test_sweep_runs_a_cell_from_the_command_line(name, roots, tmp_path):
    given = settings_of(name, roots)
    fixed = {key_of(argument) for argument in given}
    cells = [
        cell
        for cell in cells_of(name)
        if not any(one.startswith(("learn=task", "recipe.warm_start=$", "seed=1")) for one in cell)
    ]
    cell = min(cells or cells_of(name), key=_size)
    free = [one for one in cell if key_of(one) not in fixed]
    params = ["hydra.sweeper.params=null"]
    if "grids" in composed(name).hydra.sweeper:
        params.append("hydra.sweeper.grids=[{}]")
    folder = FOLDERS[name]
    own = [] if folder == sweeps_dir() else ["--config-dir", str(folder)]
    sweep = ["-m", *own, "--config-name", name, f"out={tmp_path}/out"]

    status, out, err = call([*sweep, *free, *given, *params], tmp_path)

    assert status == 0, out + err
    assert "1 cells: 1 completed" in out


@pytest.mark.parametrize(
    ("name", "one"), [("noise", "test_noise_std=0.01"), ("corruptions", "test_corruption=jitter-1")]
)
def test_sweep_of_tests_runs_with_its_own_params(name, one, roots, tmp_path):
    """Hydra reads the params of the file before the command line, so these must be complete."""
    sweep = ["-m", "--config-name", name, *settings_of(name, roots), one, f"out={tmp_path}/out"]

    status, out, err = call(sweep, tmp_path)

    assert status == 0, out + err
    assert "1 cells: 1 completed" in out


def _size(cell):
    """Return the number of points of a cell, which its cost depends on."""
    sizes = [int(one.partition("=")[2]) for one in cell if re.fullmatch(r"m=\d+", one)]
    return sizes[0] if sizes else 0
