"""The chunks of one file shared among Dask workers, one of which is killed."""

import os
import signal
import sys

import distributed
import laspy
import numpy as np
import pytest
import torch

from mops_lightning.downsample.cluster import cluster, engine_of, environment_kept
from mops_lightning.downsample.formats.registry import WRITERS, open_cloud_file, read
from mops_lightning.downsample.formats.table import Table
from mops_lightning.downsample.large import by_chunks
from mops_lightning.errors import UserError
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.zoo import weights
from tests.support.downsample import call


@pytest.fixture(scope="module")
def client():
    with (
        environment_kept(),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as two,
        distributed.Client(two) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """A cloud with a hole in its numbers, and a sampler."""
    folder = tmp_path_factory.mktemp("scan")
    points = np.random.default_rng(0).normal(size=(3000, 3)) * [5, 1, 1] + [1000, 0, 0]
    points[200:420] = np.nan
    points[700] = points[1900]  # equally near ones in different chunks
    WRITERS[".ply"](folder / "scan.ply", Table(points, {"label": np.arange(3000)}))
    torch.manual_seed(0)
    node = {"_target_": "mops_lightning.samplers.mops.MOPSNet", "m": 24}
    sampler = MOPSNet(24).eval()
    weights.save(folder / "weights.pt", sampler, {"learn": "sampler", "sampler": node}, {})
    return folder / "scan.ply", sampler


def same(one: Table, other: Table) -> None:
    np.testing.assert_array_equal(one.points, other.points)
    assert list(one.columns) == list(other.columns)
    for name, column in one.columns.items():
        np.testing.assert_array_equal(column, other.columns[name])


@pytest.mark.parametrize("readout", ["generated", "matched"])
def test_workers_give_what_one_process_gives(readout, client, scan):
    here, number, _ = by_chunks(scan[0], scan[1], 24, 300, readout, True)
    there, same_number, left_out = by_chunks(
        scan[0], scan[1], 24, 300, readout, True, engine_of(client)
    )
    assert (number, same_number, left_out) == (2780, 2780, 220)
    # Threads differ between the two, and with them the order of sums.
    np.testing.assert_allclose(there.points, here.points, atol=1e-5 * np.ptp(here.points))


def test_a_worker_that_is_killed_does_not_change_the_result(client, scan):
    engine, killed = engine_of(client), []
    whole, *_ = by_chunks(scan[0], scan[1], 24, 300, "matched", True, engine)

    def killing(title, function, cloud, row_ranges, *common):
        for done, result in enumerate(engine(title, function, cloud, row_ranges, *common)):
            if title in ("sampling", "matching") and done == 3:
                pids = client.run(os.getpid)
                os.kill(next(iter(pids.values())), signal.SIGKILL)
                killed.append(title)
            yield result

    again, *_ = by_chunks(scan[0], scan[1], 24, 300, "matched", True, killing)
    assert killed == ["sampling", "matching"]
    same(again, whole)


def test_from_the_command_line(scan, tmp_path):
    before = dict(os.environ)
    settings = ["--weights", scan[0].parent, "--readout", "matched", "--keep-attributes"]
    settings += ["--chunk", 500]
    assert call(scan[0], tmp_path / "one.npz", *settings)[0] == 0
    status, out, err = call(
        scan[0], tmp_path / "two.npz", *settings, "--cluster", "local", "--workers", 2
    )
    assert (status, err) == (0, "")
    assert "24 of 2,780 points (220 more without finite coordinates left out)" in out
    same(read(tmp_path / "one.npz", 9, 0), read(tmp_path / "two.npz", 9, 0))
    assert dict(os.environ) == before, "what comes later must not be bound to one thread"


def test_a_scheduler_that_runs_already_is_used(client, scan, tmp_path):
    settings = ["--weights", scan[0].parent, "--readout", "generated", "--chunk", 500]
    address = client.scheduler.address
    assert call(scan[0], tmp_path / "a.ply", *settings, "--cluster", address)[::2] == (0, "")


def test_a_broken_file_is_named_by_the_workers(client, scan, tmp_path):
    (tmp_path / "in").mkdir()
    content = scan[0].read_bytes()
    (tmp_path / "in" / "bad.ply").write_bytes(content[:-50])
    (tmp_path / "in" / "good.ply").write_bytes(content)
    settings = ["--weights", scan[0].parent, "--readout", "generated", "--chunk", 500]
    address = client.scheduler.address
    status, out, err = call(tmp_path / "in", tmp_path / "out", *settings, "--cluster", address)
    assert status == 1
    assert "bad.ply is broken: it ends after 2996 points" in err
    assert "2 files: 1 failed, 1 done" in out


def test_no_scheduler_at_the_address(scan, tmp_path, monkeypatch):
    monkeypatch.setattr("mops_lightning.downsample.cluster.PATIENCE", 1)
    settings = ["--weights", scan[0].parent, "--readout", "generated", "--chunk", 500]
    for address in ("tcp://127.0.0.1:9", "nonsense://"):
        status, _, err = call(scan[0], tmp_path / "a.ply", *settings, "--cluster", address)
        assert status == 2
        assert f"no Dask scheduler answers at {address}" in err


def test_a_scheduler_without_workers(monkeypatch):
    monkeypatch.setattr("mops_lightning.downsample.cluster.PATIENCE", 1)
    with (
        environment_kept(),
        distributed.LocalCluster(n_workers=0, dashboard_address=":0") as empty,
        pytest.raises(UserError, match="has no workers"),
        cluster(empty.scheduler_address, 1),
    ):
        raise AssertionError("there is nobody to work")


def test_without_dask_the_package_is_named(scan, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    settings = ["--weights", scan[0].parent, "--readout", "generated", "--chunk", 500]
    status, _, err = call(scan[0], tmp_path / "a.ply", *settings, "--cluster", "local")
    assert status == 2
    assert "pip install 'mops-lightning[cluster]'" in err


def test_what_does_not_go_with_a_cluster(scan, tmp_path):
    settings = ["--weights", scan[0].parent, "--readout", "generated", "--cluster", "local"]
    status, _, err = call(scan[0], tmp_path / "a.ply", *settings)
    assert status == 2
    assert "give --chunk" in err
    status, _, err = call(scan[0], tmp_path / "a.ply", *settings[:-1], "", "--chunk", 500)
    assert status == 2
    assert "got ''" in err


def test_a_scheduler_that_goes_away(scan):
    with (
        environment_kept(),
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address=":0", silence_logs=50
        ) as one,
        distributed.Client(one) as client,
    ):
        engine = engine_of(client)

        def closing(*arguments):
            for result in engine(*arguments):
                if one.status.name == "running":
                    one.close()
                yield result

        with pytest.raises(UserError, match="the scheduler has gone"):
            by_chunks(scan[0], scan[1], 24, 10, "generated", False, closing)


HEADS = {
    "comment between": ("property float z", "comment made by hand\nproperty float z"),
    "obj_info between": ("property float z", "obj_info num_cols 4\nproperty float z"),
    "blanks and tabs": ("property float z", "property \t float   z \t"),
    "element in a comment": ("element vertex", "comment one element per scan\nelement vertex"),
    "line ends of Windows": ("\n", "\r\n"),
}


@pytest.mark.parametrize("kind", HEADS)
def test_a_head_of_ply_may_be_written_in_other_ways(kind, tmp_path):
    points = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32).astype(float)
    path = tmp_path / "a.ply"
    WRITERS[".ply"](path, Table(points, {"red": np.arange(50, dtype=np.uint8)}))
    head, end, rows = path.read_bytes().partition(b"end_header\n")
    path.write_bytes((head + end).decode().replace(*HEADS[kind]).encode() + rows)
    table = open_cloud_file(path).read(range(10, 50))
    np.testing.assert_array_equal(table.points, points[10:])
    np.testing.assert_array_equal(table.columns["red"], np.arange(10, 50))


def test_vertices_with_lists_are_refused(tmp_path):
    path = tmp_path / "a.ply"
    head = "element vertex 1\nproperty float x\nproperty list uchar int seen\n"
    path.write_text(f"ply\nformat binary_little_endian 1.0\n{head}end_header\n")
    with pytest.raises(UserError, match="without lists"):
        open_cloud_file(path)


@pytest.mark.parametrize("chunked", [True, False])
def test_a_las_file_that_is_cut_between_points_is_broken(chunked, tmp_path):
    path = tmp_path / "a.las"
    points = np.random.default_rng(1).normal(size=(90, 3))
    WRITERS[".las"](path, Table(points))
    with laspy.open(path) as file:
        length = file.header.point_format.size
    path.write_bytes(path.read_bytes()[: -30 * length])
    with pytest.raises(UserError, match="ends after 60 points"):
        open_cloud_file(path).read(range(90)) if chunked else read(path, 9, 0)


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("shape", [(20, 10), ()])
def test_named_fields_need_one_row_a_point(shape, chunked, tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros(shape, [("x", "f4"), ("y", "f4"), ("z", "f4")]))
    with pytest.raises(UserError, match="one row of fields per point"):
        open_cloud_file(path) if chunked else read(path, 9, 0)


@pytest.mark.parametrize("chunked", [True, False])
def test_named_coordinates_must_be_numbers(chunked, tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros(20, [("x", "f4"), ("y", "c8"), ("z", "f4")]))
    with pytest.raises(UserError, match="y must be numbers, got complex64"):
        open_cloud_file(path).read(range(9)) if chunked else read(path, 9, 0)


@pytest.mark.parametrize("size", [500, 3000])
def test_what_a_damaged_laz_file_gives_is_no_cloud(size, tmp_path):
    path = tmp_path / "a.laz"
    WRITERS[".laz"](path, Table(np.random.default_rng(1).uniform(0, 50, size=(3000, 3))))
    content = bytearray(path.read_bytes())
    content[600:1500] = bytes(np.random.default_rng(2).integers(0, 256, 900, np.uint8))
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"a\.laz is broken"):
        open_cloud_file(path).read(range(size))


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".bin", ".las", ".laz"])
def test_any_stretch_of_a_file_can_be_read_alone(suffix, tmp_path):
    points = np.random.default_rng(1).normal(size=(500, 3)).astype(np.float32).astype(float)
    path = tmp_path / f"in{suffix}"
    WRITERS[suffix](path, Table(points, {"intensity": np.arange(500, dtype=np.uint16)}))
    cloud = open_cloud_file(path)
    assert cloud.number == 500
    assert [len(rows) for rows in cloud.row_ranges(200)] == [200, 200, 100]
    whole = cloud.read(range(500))
    np.testing.assert_allclose(whole.points, points, atol=1e-6)
    for rows in (range(0, 3), range(200, 400), range(499, 500)):
        np.testing.assert_array_equal(cloud.read(rows).points, whole.points[rows.start : rows.stop])
