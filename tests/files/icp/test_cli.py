"""``compare --task icp`` as a user types it."""

import csv
import re
import sys

import numpy as np
import pytest

from mops_lightning.files.cli import compare
from tests.support.cloud_files import write_cloud


def room(number, seed):
    """Points on a floor, two walls and a step."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(0, 4, (2, number))
    zero = np.zeros(number)
    faces = np.stack(
        [
            np.stack([u, v, zero], 1),
            np.stack([u, zero, v], 1),
            np.stack([zero, u, v], 1),
            np.stack([u / 4 + 1, v / 4 + 2, zero + 0.5], 1),
        ]
    )
    return faces[rng.integers(4, size=number), np.arange(number)]


@pytest.fixture
def scans(tmp_path):
    folder = tmp_path / "scans"
    folder.mkdir()
    for number in range(2):
        write_cloud(folder / f"{number}.ply", room(1500, number))
    return folder


def called(*arguments):
    compare([str(argument) for argument in arguments])


def refused(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        called(*arguments)
    assert stop.value.code == 2
    return capsys.readouterr().err


def rows_of(folder):
    with (folder / "table.csv").open() as file:
        return list(csv.DictReader(file))


def test_crops_give_a_row_for_every_method_size_registration_and_draw(scans, tmp_path, capsys):
    out = tmp_path / "out"

    called("--task", "icp", scans, "--m", 16, 40, "--draws", 2, "--crops", 2, "--points", 600,
           "--methods", "fps_farthest", "random", "information", "small_gicp_voxel",
           "--out", out)  # fmt: skip

    rows = rows_of(out)
    assert len(rows) == 2 * 2 * (1 + 2 * 4)
    assert {row["pairs"] for row in rows} == {"4"}
    whole = [float(row["degrees"]) for row in rows if row["method"] == "all points"]
    assert max(whole) < 5
    voxels = [float(row["points"]) for row in rows if row["method"] == "small_gicp_voxel"]
    assert all(10 <= number <= 40 for number in voxels)
    printed = capsys.readouterr().out
    assert "plane, 16 points: 2 draws of 4 alignments" in printed
    assert "against fps_farthest" in printed
    assert printed.endswith(f"files in {out}/: table.csv, compare.html\n")


def test_two_runs_of_one_seed_find_the_same_errors(scans, tmp_path):
    found = []
    for name in ("first", "second"):
        called("--task", "icp", scans, "--m", 20, "--draws", 1, "--crops", 1, "--points", 300,
               "--out", tmp_path / name)  # fmt: skip
        rows = rows_of(tmp_path / name)
        found.append([(row["method"], row["degrees"], row["shift"]) for row in rows])

    assert found[0] == found[1]
    assert len(found[0]) == 2 * (1 + 11)


def test_frames_with_poses_are_aligned_to_the_true_motion(tmp_path, capsys):
    folder, out = tmp_path / "frames", tmp_path / "out"
    folder.mkdir()
    for number in range(3):
        write_cloud(folder / f"{number}.ply", room(3000, number) - [0.2 * number, 0, 0])
    poses = tmp_path / "poses.txt"
    poses.write_text("".join(f"1 0 0 {0.2 * i} 0 1 0 0 0 0 1 0\n" for i in range(3)))

    called("--task", "icp", folder, "--poses", poses, "--m", 300, "--draws", 2, "--methods",
           "covariance", "--registration", "plane", "--shift", 0.1, "--out", out)  # fmt: skip

    rows = rows_of(out)
    assert [row["method"] for row in rows] == ["all points", "covariance"] * 2
    assert max(float(row["degrees"]) for row in rows) < 0.5
    assert max(float(row["shift"]) for row in rows) < 0.05
    starts = {row["degrees"] for row in rows if row["method"] == "all points"}
    assert len(starts) == 2  # of every draw its own: frames are the same
    assert "plane, 300 points: 2 draws of 2 alignments" in capsys.readouterr().out


def test_trained_sampler_is_compared_by_its_completed_sets(scans, tmp_path):
    called("--task", "icp", scans, "--m", 20, "--draws", 1, "--crops", 1, "--points", 300,
           "--methods", "random", "--weights", "fmops.modelnet40-m512",
           "--out", tmp_path / "out")  # fmt: skip

    rows = [row for row in rows_of(tmp_path / "out") if row["method"] == "trained"]
    assert [row["registration"] for row in rows] == ["plane", "gicp"]
    assert {row["points"] for row in rows} == {"20.0"}


def test_target_is_sampled_where_that_is_asked_for(scans, tmp_path):
    degrees = []
    for number, words in enumerate(([], ["--sample-target"])):
        called("--task", "icp", scans, "--m", 100, "--draws", 1, "--crops", 2, "--points", 600,
               "--methods", "random", "--out", tmp_path / str(number), *words)  # fmt: skip
        degrees.append([float(row["degrees"]) for row in rows_of(tmp_path / str(number))])

    whole, sampled = degrees
    assert whole[:2] == sampled[:2]  # plane and gicp from all points
    assert whole[2] != sampled[2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--m", 9], "--m must be from 10, the fewest points that small_gicp aligns"),
        (["--m", 151, "--points", 300], "--m must be from 10, .* to 150, .* got 151"),
        (["--m", 20, "--points", 9999], "has 1,500 points, fewer than --points 9999"),
        (["--m", 20, "--methods", "fsp"], "--methods: unknown 'fsp'.*fps"),
        (["--m", 20, "--draws", 0], "--draws must be at least 1, got 0"),
        (["--m", 20, "--angle", -1], "--angle must be at least 0, got -1.0"),
        (["--m", 20, "--max-distance", 0], "--max-distance must be a number above 0, got 0.0"),
        (["--m", 20, "--tile", 100], "--tile is for the trained sampler"),
        (["--m", 20, "--weights", "nowhere.pt"], "--weights: no file nowhere.pt"),
        (["--m", 600, "--weights", "fmops.modelnet40-m512"], "trained for up to 512 points"),
        (["--m", 20, "--poses", "no.txt", "--crops", 3], "--crops is for crops"),
        (["--m", 20, "--poses", "no.txt"], "no.txt cannot be read as text"),
    ],
)
def test_mistakes_end_in_one_line(scans, tmp_path, capsys, arguments, message):
    error = refused(capsys, "--task", "icp", scans, *arguments, "--out", tmp_path / "out")

    assert re.search(message, error), error


def test_options_of_icp_are_refused_without_it(scans, tmp_path, capsys):
    error = refused(capsys, scans / "0.ply", "--m", 20, "--draws", 3, "--out", tmp_path / "out")

    assert "--draws is for --task icp" in error


def test_one_folder_is_needed(scans, tmp_path, capsys):
    out = ["--m", 20, "--out", tmp_path / "out"]

    several = refused(capsys, "--task", "icp", scans, scans, *out)
    assert "--task icp takes one folder of scans, got 2 paths" in several
    file = refused(capsys, "--task", "icp", scans / "0.ply", *out)
    assert "--task icp takes one folder of scans, got" in file


def test_wrong_folder_is_reported_before_a_sampler_is_loaded(scans, tmp_path, capsys):
    wrong = ["--task", "icp", tmp_path / "none", "--m", 20, "--weights", "no.such.model"]

    assert "takes one folder of scans, got" in refused(capsys, *wrong)


def test_missing_library_is_named(scans, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "small_gicp", None)

    error = refused(capsys, "--task", "icp", scans, "--m", 20, "--out", tmp_path / "out")

    assert "pip install 'mops-lightning[icp]'" in error
