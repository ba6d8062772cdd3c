"""Folders of files, and worker processes that share them."""

import os

import numpy as np
import pytest

from mops_lightning.files import batch
from mops_lightning.files.options import Options
from tests.support.clouds import uniform_points
from tests.support.downsample import call, done


def test_folder_second_run_does_only_missing_files(folder, tmp_path):
    target = tmp_path / "out"
    bad = folder / "in" / "bad.xyz"
    bad.write_text("not a cloud\n")
    try:
        settings = ["--weights", folder / "weights.safetensors", "--m", 8]
        status, out, err = call(folder / "in", target, *settings, "--workers", 2)
        assert status == 1
        assert "3 files: " in out
        assert "2 done" in out
        assert "1 failed" in out
        assert err.startswith(f"failed: {bad}")
        first = {path.name: path.read_bytes() for path in target.rglob("*.*")}
        assert set(first) == {"a.ply", "b.npz"}
        assert (target / "deep" / "b.npz").is_file()
        (target / "a.ply").unlink()
    finally:
        bad.unlink()
    out = done(folder / "in", target, *settings)
    assert "2 files: 1 done, 1 done before" in out
    again = {path.name: path.read_bytes() for path in target.rglob("*.*")}
    assert again == first, "one process gives what two gave"


def test_folder_counts_the_points_left_out_of_all_files(tmp_path):
    source = tmp_path / "in"
    source.mkdir()
    for missing in (1, 2, 4):
        points = uniform_points(20, missing)
        points[:missing] = np.nan
        np.save(source / f"{missing}.npy", points)

    out = done(source, tmp_path / "out", "--method", "random", "--m", 5)

    assert "3 files: 3 done; 7 points without finite coordinates left out" in out


def test_dead_worker_is_reported_and_second_run_completes(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "attempt", die)
    settings = ["--method", "random", "--m", 5]
    status, out, err = call(folder / "in", tmp_path, *settings, "--workers", 2)
    assert status == 1
    assert err.count("its process died") == 2
    assert "2 files: 2 failed" in out
    monkeypatch.undo()
    assert call(folder / "in", tmp_path, *settings)[0] == 0


def die(*_):
    os._exit(9)


@pytest.mark.parametrize(("workers", "threads"), [(1, 8), (3, 2), (8, 1), (99, 1)])
def test_workers_share_the_cores_of_the_machine(workers, threads, tmp_path, monkeypatch):
    chosen: list[int] = []
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    monkeypatch.setattr("torch.set_num_threads", chosen.append)
    np.save(tmp_path / "a.npy", uniform_points(20, 0))
    options = Options(5, method="random")

    batch.attempt(tmp_path / "a.npy", tmp_path / "b.npy", options, workers)
    batch.attempt(tmp_path / "a.npy", tmp_path / "c.npy", options)

    assert chosen == [threads]
