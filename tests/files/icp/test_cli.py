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
    floor = np.stack([u, v, zero], 1)
    left_wall = np.stack([u, zero, v], 1)
    right_wall = np.stack([zero, u, v], 1)
    step = np.stack([u / 4 + 1, v / 4 + 2, zero + 0.5], 1)
    faces = np.stack([floor, left_wall, right_wall, step])
    face_of_point = rng.integers(4, size=number)
    return faces[face_of_point, np.arange(number)]


@pytest.fixture
def scans(tmp_path):
    folder = tmp_path / "scans"
    folder.mkdir()
    for number in range(2):
        points = room(1500, number)
        write_cloud(folder / f"{number}.ply", points)
    return folder


def called(*arguments):
    words = [str(argument) for argument in arguments]
    compare(words)


def refused(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        called(*arguments)
    assert stop.value.code == 2
    return capsys.readouterr().err


def rows_of(folder):
    with (folder / "table.csv").open() as file:
        return list(csv.DictReader(file))


def numbers_of(rows, column, method=None):
    """Return the numbers of a column, in all rows or in those of a method."""
    numbers = []
    for row in rows:
        if method in (None, row["method"]):
            numbers.append(float(row[column]))
    return numbers


def test_crops_give_a_row_for_every_method_size_registration_and_draw(scans, tmp_path, capsys):
    out = tmp_path / "out"

    called("--task", "icp", scans, "--m", 16, 40, "--draws", 2, "--crops", 2, "--points", 600,
           "--methods", "fps_farthest", "random", "information", "small_gicp_voxel",
           "--out", out)  # fmt: skip

    rows = rows_of(out)
    assert len(rows) == 2 * 2 * (1 + 2 * 4)
    assert {row["pairs"] for row in rows} == {"4"}
    degrees = numbers_of(rows, "degrees", "all points")
    assert max(degrees) < 5
    voxels = numbers_of(rows, "points", "small_gicp_voxel")
    assert min(voxels) >= 10
    assert max(voxels) <= 40
    assert {row["sampling"] for row in rows if row["method"] == "all points"} == {"0.0"}
    assert min(numbers_of(rows, "sampling", "information")) > 0
    assert min(numbers_of(rows, "aligning")) > 0
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


def errors_of_all_points(scans, out, seed):
    """Return the rotation error of each draw, where starts are the truth: it is that of crops."""
    called("--task", "icp", scans, "--m", 10, "--draws", 2, "--crops", 1, "--points", 200,
           "--methods", "random", "--registration", "gicp", "--angle", 0, "--shift", 0,
           "--seed", seed, "--out", out)  # fmt: skip
    return numbers_of(rows_of(out), "degrees", "all points")


def test_crops_are_those_of_the_draw_and_of_the_seed(scans, tmp_path):
    of_first_seed = errors_of_all_points(scans, tmp_path / "0", 0)
    of_other_seed = errors_of_all_points(scans, tmp_path / "1", 1)

    assert len({*of_first_seed, *of_other_seed}) == 4


def test_starts_are_those_of_the_seed_for_the_same_frames(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    poses = tmp_path / "poses.txt"
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    for number in range(2):
        write_cloud(folder / f"{number}.ply", room(300, number))

    found = []
    for seed in (0, 1):
        out = tmp_path / str(seed)
        called("--task", "icp", folder, "--poses", poses, "--m", 10, "--draws", 1, "--methods",
               "random", "--registration", "gicp", "--seed", seed, "--out", out)  # fmt: skip
        found += numbers_of(rows_of(out), "degrees", "all points")

    assert found[0] != found[1]


def test_columns_name_those_of_bin_scans(tmp_path):
    folder = tmp_path / "scans"
    folder.mkdir()
    room(399, 0).astype(np.float32).tofile(folder / "a.bin")  # 4,788 bytes: no rows of four

    called("--task", "icp", folder, "--m", 10, "--draws", 1, "--crops", 1, "--points", 200,
           "--methods", "random", "--registration", "gicp", "--columns", "x,y,z",
           "--out", tmp_path / "out")  # fmt: skip

    assert len(rows_of(tmp_path / "out")) == 2


def test_frames_with_poses_are_aligned_to_the_true_motion(tmp_path, capsys):
    folder = tmp_path / "frames"
    out = tmp_path / "out"
    poses = tmp_path / "poses.txt"
    folder.mkdir()
    lines = []
    for number in range(3):
        way = 0.2 * number
        points = room(3000, number) - [way, 0, 0]
        write_cloud(folder / f"{number}.ply", points)
        lines.append(f"1 0 0 {way} 0 1 0 0 0 0 1 0\n")
    poses.write_text("".join(lines))

    called("--task", "icp", folder, "--poses", poses, "--m", 300, "--draws", 2, "--methods",
           "covariance", "--registration", "plane", "--shift", 0.1, "--out", out)  # fmt: skip

    rows = rows_of(out)
    assert [row["method"] for row in rows] == ["all points", "covariance"] * 2
    degrees = numbers_of(rows, "degrees")
    shifts = numbers_of(rows, "shift")
    assert max(degrees) < 0.5
    assert max(shifts) < 0.05
    starts = numbers_of(rows, "degrees", "all points")
    assert len(set(starts)) == 2  # of every draw its own: frames are the same
    assert "plane, 300 points: 2 draws of 2 alignments" in capsys.readouterr().out


def test_trained_sampler_is_compared_by_its_completed_sets(scans, tmp_path):
    called("--task", "icp", scans, "--m", 20, "--draws", 1, "--crops", 1, "--points", 300,
           "--methods", "random", "--weights", "fmops.modelnet40-m512",
           "--out", tmp_path / "out")  # fmt: skip

    rows = rows_of(tmp_path / "out")
    trained = [row for row in rows if row["method"] == "trained"]
    assert [row["registration"] for row in trained] == ["plane", "gicp"]
    assert [row["points"] for row in trained] == ["20.0", "20.0"]


def test_target_is_sampled_where_that_is_asked_for(scans, tmp_path):
    degrees = []
    for number, words in enumerate(([], ["--sample-target"])):
        out = tmp_path / str(number)
        called("--task", "icp", scans, "--m", 100, "--draws", 1, "--crops", 2, "--points", 600,
               "--methods", "random", "--out", out, *words)  # fmt: skip
        rows = rows_of(out)
        degrees.append(numbers_of(rows, "degrees"))

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
    out = tmp_path / "out"

    error = refused(capsys, "--task", "icp", scans, *arguments, "--out", out)

    assert re.search(message, error), error


def test_options_of_icp_are_refused_without_it(scans, tmp_path, capsys):
    settings = ["--m", 20, "--draws", 3, "--out", tmp_path / "out"]

    error = refused(capsys, scans / "0.ply", *settings)

    assert "--draws is for --task icp" in error


def test_one_folder_is_needed(scans, tmp_path, capsys):
    out = ["--m", 20, "--out", tmp_path / "out"]

    several = refused(capsys, "--task", "icp", scans, scans, *out)
    assert "--task icp takes one folder of scans, got 2 paths" in several
    file = refused(capsys, "--task", "icp", scans / "0.ply", *out)
    assert "--task icp takes one folder of scans, got" in file


def test_wrong_folder_is_reported_before_a_sampler_is_loaded(scans, tmp_path, capsys):
    settings = ["--m", 20, "--weights", "no.such.model"]

    error = refused(capsys, "--task", "icp", tmp_path / "none", *settings)

    assert "takes one folder of scans, got" in error


def test_missing_library_is_named(scans, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "small_gicp", None)

    settings = ["--m", 20, "--out", tmp_path / "out"]

    error = refused(capsys, "--task", "icp", scans, *settings)

    assert "pip install 'mops-lightning[icp]'" in error
