"""Runs that are stopped and resumed by the same command."""

import signal
import time

import pytest
import torch

from mops_lightning.records import run_record
from mops_lightning.training.checkpoint import read_sealed
from mops_lightning.training.experiment import Experiment
from tests.support.command_line import TINY, call, runs
from tests.support.forked import start_fork


def final_state(run):
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


LONGER = [*TINY, "trainer.max_epochs=6", "dataset.train_per_class=12"]


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    status, out, err = call(LONGER, folder)
    assert status == 0, err
    (run,) = runs(folder)
    return folder, final_state(run)


@pytest.mark.parametrize(
    ("number", "left"), [(signal.SIGINT, "interrupted"), (signal.SIGKILL, "running")]
)
def test_run_stopped_mid_epoch_resumes_to_same_weights(unbroken, number, left):
    folder, want = unbroken
    out = f"stopped-{left}"
    process = start_fork([*LONGER, f"out={out}"], folder)
    for line in process.stdout:
        if line.startswith("epoch 2/"):
            break
    time.sleep(0.05)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    (run,) = (path.parent for path in (folder / out).rglob("result.json"))
    assert run_record.read(run).status == left
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert "ckpt_path=" in err
        assert "Traceback" not in err
    # A folder of its own: both runs may start in the same second.
    again = [*LONGER, f"out={out}", "ckpt_path=last", f"hydra.run.dir={out}/resumed"]
    status, _, err = call(again, folder)
    assert status == 0, err
    (resumed,) = (path.parent for path in (folder / out).rglob("result.json") if path.parent != run)
    checkpoint = run / "checkpoints" / "last.ckpt"
    record = run_record.read(resumed)
    assert record.resumed_from == str(checkpoint.relative_to(folder))
    before = read_sealed(checkpoint)["callbacks"]["CPUTime"]["seconds"]
    assert 0 < before < record.seconds["fit_cpu"]
    got = final_state(resumed)
    assert got.keys() == want.keys()
    different = [name for name in want if not torch.equal(got[name], want[name])]
    assert different == []


SHORT = [*TINY, "trainer.max_epochs=3", "weights=null", "baselines={}"]
"""Epochs of two steps; the default recipe, with a moving average of the weights."""


@pytest.mark.parametrize("stops", [[1, 3], ["test"]], ids=["two ends of epochs", "test"])
def test_stopped_run_resumed_by_same_command_tests_same_weights(tmp_path, monkeypatch, stops):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    status, _, err = call([*SHORT, "out=unbroken"], tmp_path)
    assert status == 0, err

    def stop_at(place):
        if place in stops:
            stops.remove(place)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(
        Experiment, "on_before_zero_grad", lambda self, _: stop_at(self.global_step)
    )
    monkeypatch.setattr(Experiment, "on_test_start", lambda _: stop_at("test"))
    for number, expected in enumerate([130] * len(stops) + [0]):
        arguments = [*SHORT, "out=stopped", f"hydra.run.dir=stopped/{number}"]
        status, _, err = call([*arguments, *(["ckpt_path=last"] if number else [])], tmp_path)
        assert status == expected, err
    want, *_, got = (
        run_record.read(path.parent)
        for out in ("unbroken", "stopped")
        for path in sorted((tmp_path / out).rglob("result.json"))
    )
    assert got.status == "completed"
    assert got.metrics == want.metrics
