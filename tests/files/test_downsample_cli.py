"""The command as a user types it."""

import pytest

from mops_lightning.filesystem import TEMPORARY
from tests.support.cloud_files import contents
from tests.support.downsample import done, refused

FPS = ["--m", 5, "--method", "fps"]
GENERATED = ["--weights", "weights.safetensors", "--readout", "generated"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--m", 5], "give --method fps|random|voxel|poisson|serial|normal_space|covariance|"),
        (["--m", 5, "--method", "fps", "--weights", "w.pt"], "--weights or --method fps, not both"),
        (["--method", "fps"], "--m must be"),
        (["--m", 0, "--method", "fps"], "--m must be"),
        (["--m", 41, "--weights", "weights.safetensors"], "trained for up to 40 points, got 41"),
        (["--m", 41, "--weights", "weights.safetensors"], "or train with sampler.m_max=41"),
        (["--weights", "task.pt"], "holds a task net"),
        (["--weights", "nowhere.pt"], "--weights: no file nowhere.pt"),
        (["--m", 500, "--method", "fps"], "holds 299 points, fewer than --m 500"),
        ([*FPS, "--chunk", 4], "--chunk must be at least --m 5, got 4"),
        ([*FPS, "--chunk", 9, "--map", "map.npz"], "use propagate after --chunk"),
        (["--weights", "weights.safetensors", "--chunk", 0], "--chunk must be at least 1, got 0"),
        (["--m", 9, "--method", "fps", "--tile", 1], "--tile must be at least 2"),
        (["--weights", "weights.safetensors", "--tile", 64], "--tile needs --m"),
        (["--m", 7000, "--method", "fps", "--tile", 64], "fewer than --m 7000"),
        (["--m", 5, "--method", "fps", "--workers", 0], "--workers must be"),
        ([*GENERATED, "--cluster", "tcp://127.0.0.1:9"], "give --chunk"),
        ([*GENERATED, "--cluster", "", "--chunk", 500], "got ''"),
        (["--m", 5, "--method", "fps", "--readout", "matched"], "--readout needs --weights"),
        (["--m", 5, "--method", "fps", "--surface", -5], "--surface must be"),
        (["--m", 5, "--method", "fps", "--seed", 2**64], "--seed must be from 0"),
        (["--m", 5, "--method", "fps", "--seed", -1], "--seed must be from 0"),
        ([*FPS, "--bounds", "0,0,5"], "--bounds must be xmin,ymin,xmax,ymax or"),
        ([*FPS, "--bounds", "0,0,nan,5"], "every min below its max, got '0,0,nan,5'"),
        ([*FPS, "--bounds", "-5,-5,0,0"], "holds 0 points in the chosen area, fewer than --m 5"),
        ([*FPS, "--level", -1], "--level must be from 0"),
        ([*FPS, "--level", 1, "--resolution", 0.5], "--level or --resolution, not both"),
        ([*FPS, "--resolution", 0], "--resolution must be a number above 0"),
        ([*FPS, "--resolution", 1], "in/a.ply: --level and --resolution need a COPC file"),
        ([*FPS, "--level", 1, "--map", "map.npz"], "--map has a row for every point"),
    ],
)
def test_mistake_ends_in_one_line(arguments, said, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder)
    out = tmp_path / "out.ply"

    line = refused("in/a.ply", out, *arguments)

    assert said in line
    assert not out.exists()


def test_existing_output_needs_overwrite(folder, tmp_path):
    source = folder / "in" / "a.ply"
    target = tmp_path / "out.ply"
    target.write_text("mine")
    settings = ["--method", "random", "--m", 5]

    line = refused(source, target, *settings)

    assert f"{target} exists" in line
    assert target.read_text() == "mine"
    done(source, target, *settings, "--overwrite")
    assert len(contents(target).points) == 5


def test_folder_removes_what_a_killed_run_left(folder, tmp_path):
    left = tmp_path / "out" / "below" / f"{TEMPORARY}cloud-x.ply"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"half")

    done(folder / "in", tmp_path / "out", "--m", 5, "--method", "fps")

    assert not left.exists()


def test_real_scans_keep_attributes(real_data, tmp_path):
    scans = real_data("scans")

    done(scans, tmp_path, "--method", "random", "--m", 100)

    fragment = contents(tmp_path / "fragment.pcd")
    bunny = contents(tmp_path / "stanford-bunny.ply")  # .obj has no room
    sweep = contents(tmp_path / "kitti_000000.bin")
    assert len(fragment.points) == 100
    assert "normal_x" in fragment.columns
    assert "nx" in bunny.columns
    assert len(sweep.columns["intensity"]) == 100


def test_downsample_of_one_point_says_point(tmp_path):
    source = tmp_path / "one.xyz"
    source.write_text("1 2 3\n")

    out = done(source, tmp_path / "small.npy", "--method", "fps", "--m", 1)

    assert "small.npy: 1 of 1 point, " in out
