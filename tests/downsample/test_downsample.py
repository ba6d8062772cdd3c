"""The command as a user types it."""

import os

import numpy as np
import pytest
import torch

from mops_lightning.downsample.formats.registry import WRITERS, read
from mops_lightning.downsample.formats.table import Table
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.zoo import weights
from tests.support.downsample import call


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
    weights.save(folder / "weights.pt", FMOPSNet(40), config, {})
    weights.save(folder / "task.pt", FMOPSNet(40), {**config, "learn": "task"}, {})
    return folder


@pytest.mark.parametrize("method", ["fps", "random", "voxel", "poisson"])
def test_an_untrained_method_keeps_rows_of_the_file(method, folder, tmp_path):
    source, target = folder / "in" / "a.ply", tmp_path / "out.npz"
    status, out, err = call(source, target, "--method", method, "--m", 20, "--keep-attributes")
    assert (status, err) == (0, "")
    assert "20 of 299 points (1 more without finite coordinates left out)" in out
    kept, whole = read(target, 9, 0), read(source, 9, 0)
    rows = kept.columns["label"].astype(int)
    assert len(set(rows)) == 20
    np.testing.assert_array_equal(kept.points, whole.points[rows])


def test_readouts_of_a_trained_sampler(folder, tmp_path):
    source = folder / "in" / "a.ply"
    whole = read(source, 9, 0).points
    found = {}
    for readout in ("generated", "matched", "completed"):
        target = tmp_path / f"{readout}.npy"
        settings = ["--weights", folder, "--readout", readout, "--m", 30]
        assert call(source, target, *settings)[0] == 0
        found[readout] = np.load(target)
        assert found[readout].shape == (30, 3)
    inside = {readout: {tuple(p) for p in points} for readout, points in found.items()}
    all_points = {tuple(p) for p in whole}
    assert not inside["generated"] & all_points
    assert inside["matched"] <= inside["completed"] <= all_points
    assert len(inside["completed"]) == 30
    # Mapped back: among the points, not in the unit sphere.
    finite = whole[np.isfinite(whole).all(1)]
    assert (found["generated"] > finite.min(0)).all()
    assert (found["generated"] < finite.max(0)).all()


def test_a_folder_is_done_again_only_where_something_is_missing_or_bad(folder, tmp_path):
    target = tmp_path / "out"
    bad = folder / "in" / "bad.xyz"
    bad.write_text("not a cloud\n")
    try:
        settings = ["--weights", folder / "weights.pt", "--m", 8, "--format", "ply"]
        status, out, err = call(folder / "in", target, *settings, "--workers", 2)
        assert status == 1
        assert "3 files: " in out
        assert "2 done" in out
        assert "1 failed" in out
        assert err.startswith(f"failed: {bad}")
        first = {path.name: path.read_bytes() for path in target.rglob("*.ply")}
        assert set(first) == {"a.ply", "b.ply"}
        assert (target / "deep" / "b.ply").is_file()
        (target / "a.ply").unlink()
    finally:
        bad.unlink()
    status, out, err = call(folder / "in", target, *settings)
    assert (status, err) == (0, "")
    assert "2 files: 1 done, 1 there already" in out
    again = {path.name: path.read_bytes() for path in target.rglob("*.ply")}
    assert again == first, "one process gives what two gave"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--m", 5], "give --weights FILE"),
        (["--m", 5, "--method", "fps", "--weights", "w.pt"], "and not both"),
        (["--method", "fps"], "--m must be"),
        (["--m", 0, "--method", "fps"], "--m must be"),
        (["--m", 41, "--weights", "weights.pt"], "trained for up to 40 points, got 41"),
        (["--weights", "task.pt"], "holds a task net"),
        (["--weights", "nowhere.pt"], "no file nowhere.pt"),
        (["--weights", "weights.pt", "--keep-attributes", "--readout", "generated"], "are new"),
        (["--m", 500, "--method", "fps"], "holds 299 points, fewer than --m 500"),
        (["--m", 5, "--method", "fps", "--chunk", 9], "--chunk goes with --weights"),
        (["--weights", "weights.pt", "--chunk", 0], "--chunk must be at least 1, got 0"),
        (["--weights", "weights.pt", "--chunk", 9], "--readout generated or matched"),
        (["--m", 5, "--method", "fps", "--workers", 0], "--workers must be"),
        (["--m", 5, "--method", "fps", "--readout", "matched"], "--readout is for --weights"),
        (["--m", 5, "--method", "fps", "--surface", -5], "--surface must be"),
        (["--m", 5, "--method", "fps", "--format", "stl"], "--format must be one of"),
    ],
)
def test_mistakes_end_in_one_clear_error(arguments, said, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder)
    status, out, err = call("in/a.ply", tmp_path / "out.ply", *arguments)
    assert (status, out) == (2, "")
    assert said in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "out.ply").exists()


def test_nothing_is_overwritten_unasked(folder, tmp_path):
    source, target = folder / "in" / "a.ply", tmp_path / "out.ply"
    target.write_text("mine")
    settings = ["--method", "random", "--m", 5]
    status, _, err = call(source, target, *settings)
    assert status == 2
    assert "is there already" in err
    assert target.read_text() == "mine"
    assert call(source, target, *settings, "--overwrite")[0] == 0
    assert len(read(target, 9, 0).points) == 5
    assert "OUT is IN" in call(source, source, *settings)[2]
    assert (
        "holds coordinates alone"
        in call(source, tmp_path / "out.obj", *settings, "--keep-attributes")[2]
    )
    assert "a file and no folder" in call(source, target / "below.ply", *settings)[2]
    assert "OUT must end in" in call(source, tmp_path / "out.stl", *settings)[2]
    assert "no such file or folder" in call(tmp_path / "no", target, *settings)[2]


def test_real_scans(real_data, tmp_path):
    scans = real_data / "scans"
    if not scans.is_dir():
        pytest.skip(f"no scans in {real_data}")
    status, out, err = call(scans, tmp_path, "--method", "random", "--m", 100, "--keep-attributes")
    assert (status, err) == (0, "")
    fragment = read(tmp_path / "fragment.pcd", 9, 0)
    assert len(fragment.points) == 100
    assert "normal_x" in fragment.columns
    assert "nx" in read(tmp_path / "stanford-bunny.ply", 9, 0).columns  # .obj has no room
    assert len(read(tmp_path / "kitti_000000.bin", 9, 0).columns["intensity"]) == 100


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".bin", ".laz"])
@pytest.mark.parametrize("readout", ["generated", "matched"])
def test_chunks_of_a_file_give_what_the_whole_file_gives(suffix, readout, folder, tmp_path):
    points = np.random.default_rng(1).normal(size=(500, 3)).astype(np.float32).astype(float)
    if suffix != ".laz":  # it holds whole numbers, NaN is none
        points[100:160] = np.nan
    source = tmp_path / f"in{suffix}"
    WRITERS[suffix](source, Table(points, {"intensity": np.arange(500, dtype=np.uint16)}))
    settings = ["--weights", folder, "--readout", readout]
    settings += ["--keep-attributes"] if readout == "matched" else []
    assert call(source, tmp_path / "whole.npz", *settings)[0] == 0
    status, out, err = call(source, tmp_path / "parts.npz", *settings, "--chunk", 60)
    assert (status, err) == (0, "")
    assert ("40 of 500 points" if suffix == ".laz" else "40 of 440 points (60 more") in out
    whole, parts = (read(tmp_path / f"{name}.npz", 9, 0) for name in ("whole", "parts"))
    np.testing.assert_allclose(parts.points, whole.points, atol=1e-5)
    assert list(parts.columns) == list(whole.columns)
    for name, column in whole.columns.items():
        np.testing.assert_array_equal(parts.columns[name], column)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.xyz", b"1 2 3", "--chunk works with .npy"),
        ("a.bin", b"123", "not a KITTI scan"),
        ("a.npy", b"123", "a.npy is broken"),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n", "does not end"),
        ("a.ply", b"\n" * 10_000, "does not end"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 9\nend_header\n", "needs binary PLY"),
    ],
)
def test_files_that_cannot_be_read_in_chunks_are_named(name, content, said, folder, tmp_path):
    (tmp_path / name).write_bytes(content)
    settings = ["--weights", folder, "--readout", "matched", "--chunk", 60]
    status, _, err = call(tmp_path / name, tmp_path / "out.ply", *settings)
    assert status == 2
    assert said in err


def test_a_truncated_file_is_named_by_its_chunks(folder, tmp_path):
    path = tmp_path / "a.ply"
    WRITERS[".ply"](path, Table(np.ones((90, 3)) * np.arange(90)[:, None]))
    path.write_bytes(path.read_bytes()[:-5])
    settings = ["--weights", folder, "--readout", "matched", "--chunk", 60]
    assert "ends after 89 points" in call(path, tmp_path / "out.ply", *settings)[2]


def test_a_dead_worker_is_named_and_the_same_command_does_the_rest(folder, tmp_path, monkeypatch):
    from mops_lightning.downsample import files

    monkeypatch.setattr(files, "attempt", die)
    settings = ["--method", "random", "--m", 5]
    status, out, err = call(folder / "in", tmp_path, *settings, "--workers", 2)
    assert status == 1
    assert err.count("a worker process died") == 2
    assert "2 files: 2 failed" in out
    monkeypatch.undo()
    assert call(folder / "in", tmp_path, *settings, "--workers", 2)[0] == 0


def die(*_):
    os._exit(9)


@pytest.mark.parametrize("size", [1e200, 1e307])
def test_coordinates_beyond_measure_are_refused(size, folder, tmp_path):
    np.save(tmp_path / "a.npy", np.random.default_rng(0).uniform(1, 9, size=(90, 3)) * size)
    learned = ["--weights", folder, "--readout", "matched", "--chunk", 60]
    for settings in (["--method", "fps", "--m", 4], learned):
        status, _, err = call(tmp_path / "a.npy", tmp_path / "b.npy", *settings)
        assert status == 2
        assert "too large" in err


def test_an_array_in_column_order_is_refused_by_chunks(folder, tmp_path):
    np.save(tmp_path / "a.npy", np.asfortranarray(np.ones((90, 3))))
    settings = ["--weights", folder, "--readout", "matched", "--chunk", 60]
    status, _, err = call(tmp_path / "a.npy", tmp_path / "b.npy", *settings)
    assert status == 2
    assert "C order" in err


def test_a_file_where_out_needs_a_folder_is_named(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((90, 3)))
    settings = ["--method", "fps", "--m", 4]
    status, _, err = call(tmp_path / "a.npy", tmp_path / "a.npy" / "b.npy", *settings)
    assert status == 2
    assert f"OUT lies in {tmp_path / 'a.npy'}, which is a file" in err
