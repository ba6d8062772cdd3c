"""``compare --task-net`` as a user types it."""

import re

import numpy as np
import pandas as pd
import pytest
import torch

from mops_lightning import FPSSampler, load
from mops_lightning.files.cli import compare
from mops_lightning.files.downsample_cli import downsample
from mops_lightning.samplers.by_budget import ByBudget
from mops_lightning.zoo.names import UNTRAINED
from tests.files.task_net.conftest import trained, write_clouds
from tests.support.captured import captured, done, refused
from tests.support.cloud_files import write_cloud
from tests.support.clouds import uniform_points

NET = """
import torch
from torch import nn

class Net(nn.Module):
    def forward(self, cloud):
        return cloud.mean(dim=1)

def loss(output, batch):
    return (output - batch.points.mean(dim=1)).norm(dim=1)

def two_numbers(output, batch):
    return torch.zeros(2)

def missing(output, batch):
    return output.sum() * float("nan")
"""


def compared(*arguments):
    """What the command prints, and its table."""
    out = done(compare, arguments)
    place = arguments.index("--out")
    folder = arguments[place + 1]
    return out, pd.read_csv(folder / "table.csv")


def test_run_is_compared_by_every_method_and_its_own_sampler(own_scans, scans, tmp_path):
    out, frame = compared(
        scans, "--task-net", own_scans, "--m", "4,8", 20, "--draws", 2, "--crops", 2,
        "--out", tmp_path / "out",
    )  # fmt: skip

    further = ("fps_farthest", "critical", "trained", "all points")
    assert set(frame.method) == {*UNTRAINED, *further}
    trained = frame[frame.method == "trained"]
    assert sorted(trained.m.unique()) == [4, 8]  # up to 16 points
    whole = frame[frame.files == "all"]
    assert set(whole.clouds) == {6 * 2}
    assert set(frame.draw) == {0, 1}
    assert re.search(r"nre cd of .*: 2 draws of 12 clouds from 6 files", out)
    assert re.search(r"\| trained \| .* \| .* \| - \|", out)
    assert re.search(r"^Use .* \(two draws\)\.$", out.splitlines()[-1])
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert written == ["compare.html", "curve.svg", "table.csv", "table.md"]
    assert (tmp_path / "out" / "table.md").read_text() in out


def test_classification_takes_classes_from_folders(classifier, classes, tmp_path):
    paths = (classes, classes / "flat" / "0.ply")  # the second one is in the first

    out, frame = compared(
        *paths, "--task-net", classifier, "--m", 8, "--draws", 3, "--methods", "random",
        "--out", tmp_path / "out",
    )  # fmt: skip

    assert set(frame.method) == {"random", "fps", "fps_farthest", "all points"}
    assert set(frame[frame.files == "all"].clouds) == {6}
    assert set(frame[frame.files == "choosing"].clouds) == {3}  # two of one class, one of the other
    # The files have a class each, so that a net that says one class is right for half of them.
    assert frame.score.between(0, 1).all()
    assert "accuracy (%)" in out
    assert "(three draws)" in out


def test_segmentation_takes_parts_from_the_column_of_training(segmenter, tmp_path):
    scans = write_clouds(tmp_path / "scans", 2, seed=8, parts=True)

    out, frame = compared(
        scans, "--task-net", segmenter, "--m", 16, "--draws", 1, "--methods", "fps",
        "--crops", 2, "--out", tmp_path / "out",
    )  # fmt: skip

    assert "mean IoU (%)" in out
    assert set(frame[frame.files == "all"].clouds) == {4}


def test_net_trained_jointly_on_farthest_points_has_no_sampler_of_its_own(tmp_path):
    data = write_clouds(tmp_path / "data", 2, seed=7, parts=True)
    net = ["task.net.points=[16,8]", "task.net.channels=[4,8,8]", "task.net.k=4"]
    parts = ["task=segmentation", "dataset.label=part", "dataset.features=[curvature]", *net]
    joint = ["learn=joint", "weights=null", "sampler=fps", "m=16", "epochs.joint=1"]
    run = trained(tmp_path, [f"dataset.root={data}", *parts, *joint])
    scans = write_clouds(tmp_path / "scans", 2, seed=8, parts=True)

    _, frame = compared(
        scans, "--task-net", run, "--m", 16, "--draws", 1, "--methods", "random", "--crops", 1,
        "--out", tmp_path / "out",
    )  # fmt: skip

    assert set(frame.method) == {"all points", "fps", "fps_farthest", "random"}
    assert load(run).m == 16


def test_registration_by_a_model_counts_pairs(scans, tmp_path):
    out, frame = compared(
        scans, "--task-net", "pcrnet.modelnet40", "--m", 16, "--draws", 1, "--points", 64,
        "--methods", "random", "--out", tmp_path / "out",
    )  # fmt: skip

    assert "rotation error (°)" in out
    assert frame[frame.files == "all"].clouds.tolist() == [6, 6, 6, 6]


def test_net_of_ones_own_is_compared_by_its_loss(scans, tmp_path, monkeypatch):
    (tmp_path / "net_of_mine.py").write_text(NET)
    monkeypatch.chdir(tmp_path)
    options = ["--points", 64, "--crops", 2, "--draws", 1, "--methods", "voxel"]

    out, frame = compared(
        scans, "--task-net", "net_of_mine.Net", "--loss", "net_of_mine.loss", "--m", 8, *options,
        "--out", tmp_path / "out",
    )  # fmt: skip

    assert (frame.loss == frame.score).all()
    assert frame[frame.method == "all points"].loss.max() == pytest.approx(0, abs=1e-6)
    assert "loss of Net: 1 draw of 12 clouds from 6 files" in out


KINDS = {
    "trained": "FMOPSNet",
    "fps": "FPSSampler",
    "fps_farthest": "FPSSampler",
    "random": "RandomSampler",
    "poisson": "PoissonSampler",
}
"""Classes of the samplers that a comparison can choose."""


def test_saved_sampler_chooses_the_best_method_of_every_number(own_scans, scans, tmp_path):
    name = tmp_path / "best"

    out, frame = compared(
        scans, "--task-net", own_scans, "--m", "4,8,16,32", "--draws", 2, "--save", name,
        "--methods", "random", "poisson", "--out", tmp_path / "out",
    )  # fmt: skip

    best = load(name)
    assert isinstance(best, ByBudget)
    lines = re.findall(r"^- (\d+) points: (\w+)", out, re.MULTILINE)
    assert [int(m) for m, _ in lines] == [4, 8, 16, 32]
    checking = frame[frame.files == "checking"]
    for m, method in lines:
        chosen = best.sampler_for(int(m))
        assert type(chosen).__name__ == KINDS[method]
        of_size = checking[checking.m == int(m)]
        means = of_size.groupby("method").score.mean()
        best_of_fps = min(means["fps"], means["fps_farthest"])
        if method not in ("fps", "fps_farthest"):
            assert means[method] < best_of_fps

    few = tmp_path / "few.npy"
    tiled = tmp_path / "tile.npy"
    done(downsample, [scans / "0.ply", few, "--weights", name, "--m", 40])
    done(downsample, [scans / "0.ply", tiled, "--weights", name, "--m", 50, "--tile", 64])
    assert np.load(few).shape == (40, 3)  # above the compared numbers: FPS
    different = np.unique(np.load(tiled), axis=0)
    assert len(different) == 50
    points = torch.rand(1, 64, 3)
    _, above = best.downsample(points, 40)
    _, by_fps = FPSSampler(40).downsample(points, 40)
    _, by_farthest = FPSSampler(40, start="farthest").downsample(points, 40)
    assert torch.equal(above, by_fps) or torch.equal(above, by_farthest)


def test_files_of_the_training_are_left_out(own_scans, tmp_path):
    data = own_scans.parent / "data"
    arguments = [data, "--task-net", own_scans, "--m", 8, "--draws", 1, "--methods", "random"]

    status, out, err = captured(compare, [*arguments, "--out", tmp_path / "out"])

    assert status == 0
    assert err == "3 of 4 files left out: the net or the sampler was trained on them.\n"
    assert "from 1 file\n" in out


def test_two_comparisons_of_a_seed_agree_exactly(own_scans, scans, tmp_path):
    tables = []
    for seed in (1, 1, 2):
        _, frame = compared(
            scans, "--task-net", own_scans, "--m", 8, "--draws", 2, "--crops", 1, "--seed", seed,
            "--methods", "random", "--out", tmp_path / "out", "--overwrite",
        )  # fmt: skip
        tables.append(frame)

    assert tables[0].equals(tables[1])
    assert not tables[0].equals(tables[2])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--m", 65], r"--m must be from 1 to 64.* got 65"),
        (["--m", 0], r"--m must be from 1 to 64.* got 0"),
        (["--m", ","], r"--m must be numbers"),
        (["--m", 8, "--points", 200], r"has 150 points, fewer than the 200"),
        (["--m", 8, "--draws", 0], r"--draws must be at least 1"),
        (["--m", 8, "--crops", 0], r"--crops must be at least 1"),
        (["--m", 8, "--methods", "fsp"], r"--methods: unknown 'fsp'.*'fps'"),
        (["--m", 8, "--tile", 64, "--weights", "x"], r"--tile is not for --task-net"),
        (["--m", 8, "--task", "icp"], r"leave --task out"),
        (["--m", 8, "--angle", 3], r"--angle is for --task icp"),
        (["--m", 8, "--label", "part"], r"--label is for segmentation"),
        (["--m", 8, "--weights", "fmops.unknown"], r"--weights: no file or model"),
        (
            ["--m", 32, "--weights", "mops.modelnet40-m16-seed0"],
            r"--m: .* was trained for 16 points",
        ),
        (["--m", 8, "--seed", -1], r"--seed must be from 0"),
    ],
)
def test_mistake_ends_in_one_line(arguments, said, own_scans, scans, tmp_path):
    out = tmp_path / "out"

    line = refused(compare, [scans, "--task-net", own_scans, *arguments, "--out", out])

    assert re.search(said, line)
    assert not out.exists()


def test_files_without_what_the_net_needs_are_refused(classifier, segmenter, scans, tmp_path):
    end = ["--m", 8, "--out", tmp_path / "out"]

    no_class = refused(compare, [scans, "--task-net", classifier, *end])
    no_part = refused(compare, [scans, "--task-net", segmenter, *end])
    other = write_clouds(tmp_path / "scans", 1, seed=8, parts=True)
    few = refused(compare, [other, "--task-net", segmenter, *end, "--save", tmp_path / "best"])
    missing = refused(compare, [tmp_path / "none.ply", "--task-net", segmenter, *end])

    assert re.search(r"no folder above it is a class of .*: flat, tall\.", no_class)
    assert "has no column 'part'" in no_part
    assert "give two files or more, got 1" in few
    assert "none.ply: no such file" in missing


def test_part_that_the_net_does_not_know_is_refused(segmenter, scans, tmp_path):
    path = tmp_path / "a.ply"
    points = uniform_points(100, 0)
    part = np.full(100, 7, np.int32)
    write_cloud(path, points, {"part": part})

    err = refused(compare, [path, "--task-net", segmenter, "--m", 8])

    assert re.search(r"100 points have a part that .* does not know, such as 7; it knows 0, 1", err)


def test_options_of_a_task_net_need_one(scans, tmp_path):
    command = [scans / "0.ply", "--m", 8]
    for name, value in (("--save", "x"), ("--label", "x"), ("--loss", "x.y")):
        err = refused(compare, [*command, name, value])
        assert f"{name} is for --task-net" in err
    several = refused(compare, [*command, "--weights", "a", "--weights", "b"])
    assert "several --weights" in several


def test_net_of_ones_own_with_a_mistake_is_refused(scans, tmp_path, monkeypatch):
    (tmp_path / "nets_with_mistakes.py").write_text(NET)
    monkeypatch.chdir(tmp_path)
    end = ["--m", 8, "--points", 64, "--out", tmp_path / "out"]

    def said(net, loss):
        return refused(compare, [scans, "--task-net", net, "--loss", loss, *end])

    module = "nets_with_mistakes"
    assert "cannot import" in said(f"{module}.Missing", f"{module}.loss")
    assert "must be a torch.nn.Module" in said(
        f"{module}.torch.manual_seed.__doc__", f"{module}.loss"
    )
    assert f"{module} has no 'los'. Did you mean 'loss'?" in said(f"{module}.Net", f"{module}.los")
    assert "one for each of" in said(f"{module}.Net", f"{module}.two_numbers")
    assert "the loss of Net must be finite; from all points it is nan" in said(
        f"{module}.Net", f"{module}.missing"
    )


def test_net_of_ones_own_without_a_loss_is_told_of_it(scans, tmp_path):
    settings = ["--m", 8, "--out", tmp_path / "out"]

    line = refused(compare, [scans, "--task-net", "my_net.build", *settings])

    assert "A net of your own needs --loss, too." in line


def test_saved_sampler_is_not_replaced_without_overwrite(own_scans, scans, tmp_path):
    file = tmp_path / "best.safetensors"
    file.write_text("mine")
    settings = ["--m", 8, "--save", tmp_path / "best", "--out", tmp_path / "out"]

    err = refused(compare, [scans, "--task-net", own_scans, *settings])

    assert re.search(r"--save: .*best.safetensors exists", err)
    assert file.read_text() == "mine"
