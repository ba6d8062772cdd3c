"""One run over two processes: the same clouds, and the same metrics as from one."""

import re

import pytest
import torch
from safetensors.torch import load_file

from mops_lightning.config.compose import compose
from mops_lightning.config.distributed import (
    check_multirun,
    check_shares,
    check_start,
    is_distributed,
    is_worker_rank,
    started_together,
)
from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from tests.support.command_line import SMALL_PCRNET, TINY, call, call_anew, done


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ((15, 99, 0, 2), "Try batch_size=16"),
        ((4, 99, 0, 4), "Try batch_size=8"),
        ((8, 3, 0, 4), "devices=3"),
        ((8, 9, 1, 2), "2 devices are too many for 1 held-out clouds"),
    ],
)
def test_check_shares_indivisible_sizes_raise(numbers, said):
    with pytest.raises(UserError, match=said):
        check_shares(*numbers)


def test_check_shares_takes_the_smallest_sizes_that_can_be_shared():
    check_shares(batch_size=8, test_clouds=4, held_out=4, processes=4)
    check_shares(batch_size=1, test_clouds=1, held_out=0, processes=1)


def test_check_start_unexpected_processes_raise(monkeypatch):
    several = compose(["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"])
    check_start(several, [])
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(UserError, match=r"hydra\.run\.dir=FOLDER"):
        check_start(several, [])
    check_start(several, ["hydra.run.dir=here"])
    with pytest.raises(UserError, match="2 processes were started"):
        check_start(compose(["trainer=cpu"]), ["hydra.run.dir=here"])


def test_wrong_batch_size_fails_before_pretraining(tmp_path):
    devices = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"]
    arguments = [*TINY[1:], *devices, "val_fraction=0", "batch_size=15"]
    status, out, err = call(arguments, tmp_path)
    assert status == 2
    assert "Try batch_size=16" in err
    assert "training it first" not in out


REGISTRATION = [
    *TINY,
    *SMALL_PCRNET,
    "logger=tensorboard",
    "learn=task",
    "trainer.max_epochs=2",
    "batch_size=8",
    "val_fraction=0.2",
    "dataset.test_per_class=8",
]


def names_in(folder):
    """Return the names of a run's files; TensorBoard's contain the time."""
    return {re.sub(r"tfevents.*", "tfevents", path.name) for path in folder.iterdir()}


def test_two_processes_equal_one_and_rank_zero_writes(tmp_path):
    """PCRNet has no BatchNorm, so that nothing but the order of sums may differ."""
    done([*REGISTRATION, "hydra.run.dir=one"], tmp_path)
    two = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "hydra.run.dir=two"]
    status, out, err = call_anew([*REGISTRATION[1:], *two], tmp_path)
    assert status == 0, err
    assert err == ""
    assert out.count("epoch 2/2") == out.count("completed in") == 1
    one = run_record.read(tmp_path / "one")
    both = run_record.read(tmp_path / "two")
    assert one.processes == 1
    assert both.processes == 2
    assert both.metrics == pytest.approx(one.metrics, rel=1e-4)
    by_one = load_file(tmp_path / "one" / "weights.safetensors")
    by_two = load_file(tmp_path / "two" / "weights.safetensors")
    for name, value in by_one.items():
        torch.testing.assert_close(by_two[name], value, rtol=1e-3, atol=1e-5)
    # Those that follow have a log of their own and nothing else.
    less = names_in(tmp_path / "one")
    more = names_in(tmp_path / "two")
    assert more - less == {"train_ddp_process_1.log"}


def test_evaluation_by_two_processes_equals_that_by_one(tmp_path):
    done([*TINY, "weights=null", "sampler=mops", "hydra.run.dir=trained"], tmp_path)
    again = ["evaluate=trained", "pictures=0", "logger=none"]
    two = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2", "hydra.run.dir=two"]

    status, _, err = call_anew([*again, *two], tmp_path)

    assert status == 0, err
    trained = run_record.read(tmp_path / "trained")
    tested = run_record.read(tmp_path / "two")
    assert tested.status == "completed"
    assert tested.processes == 2
    assert tested.metrics == pytest.approx(trained.metrics, rel=1e-5, abs=1e-6)


RANKS = ["RANK", "LOCAL_RANK", "NODE_RANK", "GROUP_RANK", "SLURM_PROCID"]


@pytest.mark.parametrize("name", RANKS)
def test_worker_rank_is_told_by_every_launcher(name, monkeypatch):
    several = compose(["trainer=ddp", "trainer.devices=2"])
    one = compose(["trainer=cpu"])

    assert not is_worker_rank(several)
    monkeypatch.setenv(name, "0")
    assert not is_worker_rank(several)
    monkeypatch.setenv(name, "1")
    assert is_worker_rank(several)
    assert not is_worker_rank(one)


@pytest.mark.parametrize(
    ("devices", "several"),
    [("1", False), ("[0]", False), ("[3]", False), ("2", True), ("[0,1]", True), ("auto", True)],
)
def test_several_devices_may_be_a_number_a_list_or_auto(devices, several):
    cfg = compose([f"trainer.devices={devices}"])

    assert is_distributed(cfg) == several
    if several:
        with pytest.raises(UserError, match=r"trainer\.devices must be 1 in a sweep \(-m\)"):
            check_multirun(cfg)
    else:
        check_multirun(cfg)


def test_one_device_on_each_of_several_nodes_is_several_devices(monkeypatch):
    cfg = compose(["trainer.devices=1", "+trainer.num_nodes=2"])
    monkeypatch.setenv("RANK", "1")

    assert is_distributed(cfg)
    assert is_worker_rank(cfg)
    assert not is_distributed(compose(["trainer.devices=1", "+trainer.num_nodes=1"]))


@pytest.mark.parametrize("name", ["WORLD_SIZE", "SLURM_NTASKS"])
def test_processes_of_a_launcher_are_known_by_their_number(name, monkeypatch):
    several = compose(["trainer=ddp", "trainer.devices=2"])

    monkeypatch.setenv(name, "1")
    assert not started_together(several)
    monkeypatch.setenv(name, "2")
    assert started_together(several)
    assert not started_together(compose(["trainer=cpu"]))
