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
    unit = normal_points(3000, 0)
    points = unit * [5, 1, 1] + [1000, 0, 0]
    points[200:420] = np.nan
    points[700] = points[1900]  # equally near ones in different chunks
    write_cloud(folder / "scan.ply", points, {"label": np.arange(3000)})
    torch.manual_seed(0)
    sampler = MOPSNet(24).eval()
    node = {"_target_": "mops_lightning.samplers.mops.MOPSNet", "m": 24}
    config = {"learn": "sampler", "sampler": node}
    weights.save(folder / "weights.safetensors", sampler, config, {})
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
        self.engine = engine
        self.watch = watch

    def map(self, title, function, row_ranges):
        results = self.engine.map(title, function, row_ranges)
        for number, result in enumerate(results):
            self.watch(title, number)
            yield result


def test_killed_worker_leaves_result_unchanged(client, scan):
    path, sampler = scan
    engine = DaskEngine(client)
    matched = options("matched")
    killed = []
    whole, *_ = sample_by_chunks(path, sampler, matched, engine)

    def kill(title, done):
        if title in ("sampling", "matching") and done == 3:
            # From this process: a worker that restarts after the first kill answers no request.
            pids = [nanny.pid for nanny in client.cluster.workers.values()]
            running = [pid for pid in pids if pid]
            os.kill(running[0], signal.SIGKILL)
            killed.append(title)

    watched = Watched(engine, kill)

    again, *_ = sample_by_chunks(path, sampler, matched, watched)

    assert killed == ["sampling", "matching"]
    same(again, whole)


@pytest.mark.parametrize("readout", ["generated", "matched"])
def test_running_scheduler_equals_one_process(readout, client, scan, tmp_path):
    path, _ = scan
    by_one = tmp_path / "one.npz"
    by_two = tmp_path / "two.npz"
    settings = ["--weights", path.parent, "--chunk", 500, "--readout", readout]

    done(path, by_one, *settings)
    out = done(path, by_two, *settings, "--cluster", client.scheduler.address)

    assert "24 of 2,780 points (220 more without finite coordinates left out)" in out
    one = contents(by_one)
    two = contents(by_two)
    # Threads differ between the two, and with them the order of sums.
    tolerance = 1e-5 * np.ptp(one.points)
    assert_allclose(two.points, one.points, atol=tolerance)
    assert_array_equal(two.columns.get("label"), one.columns.get("label"))


GENERATED = ["--readout", "generated", "--chunk", 500]


def test_broken_file_is_named(client, scan, tmp_path):
    path, _ = scan
    folder = tmp_path / "in"
    folder.mkdir()
    content = path.read_bytes()
    three_points_and_a_byte = 3 * 28 + 1
    (folder / "bad.ply").write_bytes(content[:-three_points_and_a_byte])
    (folder / "good.ply").write_bytes(content)
    settings = ["--weights", path.parent, *GENERATED, "--cluster", client.scheduler.address]

    status, out, err = call(folder, tmp_path / "out", *settings)

    assert status == 1
    assert "bad.ply is broken: it ends after 2996 points" in err
    assert "2 files: 1 failed, 1 done" in out


def test_missing_scheduler_is_reported(scan, tmp_path, monkeypatch):
    monkeypatch.setattr("mops_lightning.files.engine.PATIENCE", 1)
    path, _ = scan
    out = tmp_path / "a.ply"
    settings = ["--weights", path.parent, *GENERATED]
    for address in ("tcp://127.0.0.1:9", "nonsense://"):
        err = refused(path, out, *settings, "--cluster", address)

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
    path, _ = scan
    out = tmp_path / "a.ply"
    settings = ["--weights", path.parent, *GENERATED, "--cluster", "tcp://127.0.0.1:9"]

    err = refused(path, out, *settings)

    assert "pip install 'mops-lightning[cluster]'" in err


def test_lost_scheduler_is_reported(scan):
    path, sampler = scan
    generated = options("generated", 10)
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
            sample_by_chunks(path, sampler, generated, engine)


@pytest.mark.parametrize("budget", [["--spacing", 0.6], ["--voxel", 0.8]])
def test_spacing_and_voxels_by_workers_equal_one_pass(budget, client, scan, tmp_path):
    path, _ = scan
    in_whole = tmp_path / "whole.npz"
    in_parts = tmp_path / "parts.npz"
    address = client.scheduler.address

    done(path, in_whole, *budget)
    done(path, in_parts, *budget, "--chunk", 500, "--cluster", address)

    whole = contents(in_whole)
    parts = contents(in_parts)
    same(parts, whole)
