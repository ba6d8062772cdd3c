"""Clouds and trained weights, as a user has them in a folder."""

from typing import Any

import distributed
import numpy as np
import pytest
import torch

from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.zoo import weights
from tests.support.dask import environment_kept


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two clouds far from the origin, one with a hole in its numbers, and trained weights."""
    folder = tmp_path_factory.mktemp("clouds")
    random = np.random.default_rng(0)
    (folder / "in" / "deep").mkdir(parents=True)
    for name, number in (("a.ply", 300), ("deep/b.npz", 200)):
        points = random.normal(size=(number, 3)) * [5, 1, 1] + [1000, 0, 0]
        points[7] = np.nan
        table = Table(points, {"label": np.arange(number)})
        WRITERS[f".{name.split('.')[1]}"](folder / "in" / name, table)
    torch.manual_seed(0)
    node = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "m_max": 40}
    config = {"learn": "sampler", "sampler": node}
    weights.save(folder / "weights.safetensors", FMOPSNet(40), config, {})
    weights.save(folder / "task.pt", FMOPSNet(40), {**config, "learn": "task"}, {})
    return folder


@pytest.fixture(scope="module")
def anchored(tmp_path_factory):
    """The folder of a sampler whose anchors are farthest points."""
    folder = tmp_path_factory.mktemp("anchored")
    node = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "m_max": 40, "anchors": "fps"}
    config = {"learn": "sampler", "sampler": node}
    weights.save(folder / "weights.safetensors", FMOPSNet(40, anchors="fps"), config, {})
    return folder


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """The folder of a sampler with local columns, whose weights are moved away from their start."""
    folder = tmp_path_factory.mktemp("local")
    settings: dict[str, Any] = {"anchors": "fps", "candidates": 3, "neighbours": 6}
    node = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "m_max": 40, **settings}
    torch.manual_seed(0)
    sampler = FMOPSNet(40, **settings)
    for weight in sampler.queries.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    weights.save(folder / "weights.safetensors", sampler, {"learn": "sampler", "sampler": node}, {})
    return folder


@pytest.fixture(scope="module")
def client():
    """A Dask client of two worker processes."""
    with (
        environment_kept(),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as two,
        distributed.Client(two) as client,
    ):
        yield client
