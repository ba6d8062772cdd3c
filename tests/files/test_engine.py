"""The chunks of one file shared among Dask workers, one of which is killed."""

import os
import signal
import sys

import distributed
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from mops_lightning.files.chunks import sample_by_chunks
from mops_lightning.files.engine import DaskEngine, Engine, dask_engine
from mops_lightning.files.options import Options
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.zoo import weights
from tests.support.cloud_files import contents, write_cloud
from tests.support.clouds import normal_points
from tests.support.dask import environment_kept
from tests.support.downsample import call, done, refused


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """A cloud with a hole in its numbers, and a sampler."""
    folder = tmp_path_factory.mktemp("scan")
    points = normal_points(3000, 0) * [5, 1, 1] + [1000, 0, 0]
    points[200:420] = np.nan
    points[700] = points[1900]  # equally near ones in different chunks
    write_cloud(folder / "scan.ply", points, {"label": np.arange(3000)})
    torch.manual_seed(0)
    node = {"_target_": "mops_lightning.samplers.mops.MOPSNet", "m": 24}
    sampler = MOPSNet(24).eval()
    weights.save(folder / "weights.safetensors", sampler, {"learn": "sampler", "sampler": node}, {})
    return folder / "scan.ply", sampler


def options(readout, size=300):
    return Options(24, "weights", readout=readout, chunk=size)


def same(one: Table, other: Table) -> None:
    assert_array_equal(one.points, other.points)
    assert list(one.columns) == list(other.columns)
    for name, column in one.columns.items():
        assert_array_equal(column, other.columns[name])


class Watched(Engine):
    """An engine that calls a function after every result."""

    def __init__(self, engine, watch):
        super().__init__()
        self.engine, self.watch = engine, watch

    def map(self, title, function, row_ranges):
        for number, result in enumerate(self.engine.map(title, function, row_ranges)):
            self.watch(title, number)
            yield result


def test_killed_worker_leaves_result_unchanged(client, scan):
    engine, killed = DaskEngine(client), []
    whole, *_ = sample_by_chunks(scan[0], scan[1], options("matched"), engine)

    def kill(title, done):
        if title in ("sampling", "matching") and done == 3:
            # From this process: a worker that restarts after the first kill answers no request.
            pids = [nanny.pid for nanny in client.cluster.workers.values()]
            os.kill(next(filter(None, pids)), signal.SIGKILL)
            killed.append(title)

    again, *_ = sample_by_chunks(scan[0], scan[1], options("matched"), Watched(engine, kill))
    assert killed == ["sampling", "matching"]
    same(again, whole)


@pytest.mark.parametrize("readout", ["generated", "matched"])
def test_running_scheduler_equals_one_process(readout, client, scan, tmp_path):
    settings = ["--weights", scan[0].parent, "--chunk", 500, "--readout", readout]
    assert call(scan[0], tmp_path / "one.npz", *settings)[0] == 0
    settings += ["--cluster", client.scheduler.address]
    out = done(scan[0], tmp_path / "two.npz", *settings)
    assert "24 of 2,780 points (220 more without finite coordinates left out)" in out
    one, two = (contents(tmp_path / f"{name}.npz") for name in ("one", "two"))
    # Threads differ between the two, and with them the order of sums.
    assert_allclose(two.points, one.points, atol=1e-5 * np.ptp(one.points))
    assert_array_equal(two.columns.get("label"), one.columns.get("label"))


def test_broken_file_is_named(client, scan, tmp_path):
    (tmp_path / "in").mkdir()
    content = scan[0].read_bytes()
    (tmp_path / "in" / "bad.ply").write_bytes(content[: -3 * 28 - 1])  # a point has 28 bytes
    (tmp_path / "in" / "good.ply").write_bytes(content)
    settings = ["--weights", scan[0].parent, "--readout", "generated", "--chunk", 500]
    address = client.scheduler.address
    status, out, err = call(tmp_path / "in", tmp_path / "out", *settings, "--cluster", address)
    assert status == 1
    assert "bad.ply is broken: it ends after 2996 points" in err
    assert "2 files: 1 failed, 1 done" in out


def test_missing_scheduler_is_reported(scan, tmp_path, monkeypatch):
    monkeypatch.setattr("mops_lightning.files.engine.PATIENCE", 1)
    settings = ["--weights", scan[0].parent, "--readout", "generated", "--chunk", 500]
    for address in ("tcp://127.0.0.1:9", "nonsense://"):
        err = refused(scan[0], tmp_path / "a.ply", *settings, "--cluster", address)
        assert f"no Dask scheduler answers at {address}" in err


def test_scheduler_without_workers_is_reported(monkeypatch):
    monkeypatch.setattr("mops_lightning.files.engine.PATIENCE", 1)
    with (
        environment_kept(),
        distributed.LocalCluster(n_workers=0, dashboard_address=":0") as empty,
        pytest.raises(UserError, match="has no workers"),
        dask_engine(empty.scheduler_address, progress=False),
    ):
        raise AssertionError("there is nobody to work")


def test_missing_dask_names_the_extra(scan, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    settings = ["--weights", scan[0].parent, "--readout", "generated", "--chunk", 500]
    err = refused(scan[0], tmp_path / "a.ply", *settings, "--cluster", "tcp://127.0.0.1:9")
    assert "pip install 'mops-lightning[cluster]'" in err


def test_lost_scheduler_is_reported(scan):
    with (
        environment_kept(),
        distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=1,
            processes=False,  # the scheduler is lost, not the worker
            protocol="tcp://",
            dashboard_address=":0",
            silence_logs=50,
        ) as one,
        distributed.Client(one) as client,
    ):

        def close(title, done):
            if one.status.name == "running":
                one.close()

        engine = Watched(DaskEngine(client), close)
        with pytest.raises(UserError, match="lost the connection"):
            sample_by_chunks(scan[0], scan[1], options("generated", 10), engine)


@pytest.mark.parametrize("budget", [["--spacing", 0.6], ["--voxel", 0.8]])
def test_spacing_and_voxels_by_workers_equal_one_pass(budget, client, scan, tmp_path):
    done(scan[0], tmp_path / "whole.npz", *budget)
    address = client.scheduler.address
    done(scan[0], tmp_path / "parts.npz", *budget, "--chunk", 500, "--cluster", address)

    same(contents(tmp_path / "parts.npz"), contents(tmp_path / "whole.npz"))
