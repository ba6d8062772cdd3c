"""``experiment=own_scans_icp`` on the command line, with tiny scans."""

import csv

import numpy as np
import pytest

from mops_lightning import PoseSampler, load
from mops_lightning.records import run_record
from mops_lightning.zoo import weights
from tests.ops.test_stability import box
from tests.support.command_line import TINY_ANY_DATA, call, done, runs

SETTINGS = [
    "experiment=own_scans_icp",
    "dataset.root=scans",
    "dataset.crops=4",
    *TINY_ANY_DATA,
    "sampler.m_max=20",
    "sizes=[10,20]",
    "m=10",
    "trainer.check_val_every_n_epoch=1",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of scans, and two runs of one seed."""
    folder = tmp_path_factory.mktemp("icp")
    (folder / "scans").mkdir()
    for seed in range(4):
        np.save(folder / "scans" / f"{seed}.npy", 10 * box(400, seed))
    done(SETTINGS, folder)
    done(["-m", *SETTINGS, "seed=0"], folder)
    return folder


def test_two_runs_of_a_seed_are_equal(folder):
    first, second = runs(folder)

    assert run_record.read(first).metrics == run_record.read(second).metrics
    assert (
        weights.read(first / "weights.safetensors")["sha256"]
        == (weights.read(second / "weights.safetensors")["sha256"])
    )


def test_record_has_the_loss_and_compares_with_samplers_without_training(folder):
    run, _ = runs(folder)

    record = run_record.read(run)

    assert "val/sampled/median_rotation_error_deg" in record.validation
    for method in ("sampled", "information", "fps_farthest", "random"):
        assert f"test/m10/{method}/median_rotation_error_deg" in record.metrics


def test_pose_learns_from_a_part_of_the_points_by_the_default_recipe(folder, tmp_path):
    settings = ["recipe=fast", "recipe.train_points=24", "m=8", "sampler.m_max=12", "sizes=[8,12]"]
    scans = f"dataset.root={folder / 'scans'}"

    done([*SETTINGS, *settings, scans], tmp_path)

    (run,) = runs(tmp_path)
    record = run_record.read(run)
    assert record.recipe is not None
    assert record.recipe["train_points"] == 24
    assert "test/m12/sampled/median_rotation_error_deg" in record.metrics


def test_run_can_be_loaded_and_compared_by_icp(folder):
    pytest.importorskip("small_gicp")
    run, _ = runs(folder)
    arguments = ["--task", "icp", "scans", "--m", "20", "--crops", "2", "--points", "64"]
    arguments += ["--draws", "1", "--methods", "information", "--weights", str(run)]

    status, _, err = call(["compare", *arguments], folder)

    assert (status, err) == (0, "")
    assert isinstance(load(run), PoseSampler)
    with (folder / "compare" / "table.csv").open() as file:
        methods = {row["method"] for row in csv.DictReader(file)}
    assert methods == {"all points", "information", "trained"}
