"""Folders of small clouds, and tiny nets that were trained on others."""

import numpy as np
import pytest

from mops_lightning.config.compose import compose
from mops_lightning.training.run.run import run
from tests.support.cloud_files import write_cloud

SMALL = [
    "trainer=cpu",
    "logger=none",
    "pictures=0",
    "dataset=clouds",
    "dataset.n_points=64",
    "dataset.crops=2",
    "batch_size=2",
    "epochs.task=1",
    "epochs.sampler=1",
    "val_fraction=0",
]
POINTS = 150


def write_clouds(folder, number, seed, parts=False, height=1.0):
    """Write boxes as .ply files: uneven in x, and with parts by their sign."""

    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(seed)
    for place in range(number):
        points = random.random((POINTS, 3)) * [3, 2, height]
        points[:, 0] **= 2
        columns = {"part": (points[:, 1] > 1).astype(np.int32)} if parts else {}
        write_cloud(folder / f"{place}.ply", points + 1000, columns)
    return folder


def trained(folder, settings):
    """Train by the settings and return the folder of the run."""
    run(compose([*SMALL, f"cache={folder / 'cache'}", *settings]), folder / "run", settings)
    return folder / "run"


@pytest.fixture(scope="session")
def top(tmp_path_factory):
    return tmp_path_factory.mktemp("task_net")


@pytest.fixture(scope="session")
def scans(top):
    """Six clouds that no net was trained on."""
    return write_clouds(top / "scans", 6, seed=1)


@pytest.fixture(scope="session")
def own_scans(top):
    """A run that trained an auto-encoder and a sampler of up to 16 points."""
    data = write_clouds(top / "own_scans" / "data", 4, seed=2)
    settings = ["sampler.m_max=16", "sizes=[8]", "m=8", "recipe.train_points=32"]
    return trained(
        top / "own_scans",
        ["experiment=own_scans", *SMALL[3:], f"dataset.root={data}", *settings],
    )


@pytest.fixture(scope="session")
def classes(top):
    """Six clouds of two classes that no net was trained on."""
    folder = top / "classes"
    write_clouds(folder / "flat", 3, seed=3, height=0.1)
    write_clouds(folder / "tall", 3, seed=4, height=9.0)
    return folder


@pytest.fixture(scope="session")
def classifier(top):
    """A run that trained a PointNet on two classes, flat and tall."""
    data = top / "classifier" / "data"
    write_clouds(data / "flat", 4, seed=5, height=0.1)
    write_clouds(data / "tall", 4, seed=6, height=9.0)
    return trained(
        top / "classifier",
        ["task=classification", "learn=task", "dataset.crop=whole", f"dataset.root={data}"],
    )


@pytest.fixture(scope="session")
def segmenter(top):
    """A run that trained a small segmentation net on two parts."""
    data = write_clouds(top / "segmenter" / "data", 4, seed=7, parts=True)
    net = ["task.net.points=[16,8]", "task.net.channels=[4,8,8]", "task.net.k=4"]
    return trained(
        top / "segmenter",
        ["task=segmentation", "learn=task", "dataset.label=part", f"dataset.root={data}", *net],
    )
