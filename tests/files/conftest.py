"""Clouds and trained weights, as a user has them in a folder."""

from typing import Any

import distributed
import numpy as np
import pytest
import torch

from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.zoo import weights
from tests.support.cloud_files import write_cloud
from tests.support.dask import environment_kept


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two clouds far from the origin, one with a hole in its numbers, and trained weights."""
    folder = tmp_path_factory.mktemp("clouds")
    clouds = folder / "in"
    random = np.random.default_rng(0)
    (clouds / "deep").mkdir(parents=True)
    for name, number in (("a.ply", 300), ("deep/b.npz", 200)):
        unit = random.normal(size=(number, 3))
        points = unit * [5, 1, 1] + [1000, 0, 0]
        points[7] = np.nan
        label = np.arange(number)
        write_cloud(clouds / name, points, {"label": label})
    torch.manual_seed(0)
    sampler = FMOPSNet(40)
    other = FMOPSNet(40)
    weights.save(folder / "weights.safetensors", sampler, config_of({"m_max": 40}), {})
    of_task_net = {**config_of({"m_max": 40}), "learn": "task"}
    weights.save(folder / "task.pt", other, of_task_net, {})
    return folder


def config_of(arguments):
    """Return the configuration of a run that trained an FMOPS-Net."""
    node = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", **arguments}
    return {"learn": "sampler", "sampler": node}


@pytest.fixture(scope="module")
def anchored(tmp_path_factory):
    """The folder of a sampler whose anchors are farthest points."""
    folder = tmp_path_factory.mktemp("anchored")
    sampler = FMOPSNet(40, anchors="fps")
    config = config_of({"m_max": 40, "anchors": "fps"})
    weights.save(folder / "weights.safetensors", sampler, config, {})
    return folder


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """The folder of a sampler with local columns, whose weights are moved away from their start."""
    folder = tmp_path_factory.mktemp("local")
    settings: dict[str, Any] = {"anchors": "fps", "candidates": 3, "neighbours": 6}
    torch.manual_seed(0)
    sampler = FMOPSNet(40, **settings)
    for weight in sampler.queries.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    config = config_of({"m_max": 40, **settings})
    weights.save(folder / "weights.safetensors", sampler, config, {})
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
