"""Runs that are stopped and resumed by the same command."""

import signal

import pytest
import torch

from mops_lightning.records import run_record
from mops_lightning.training.experiment import Experiment
from mops_lightning.zoo import weights
from tests.support.command_line import TINY, call, done

SHORT = [*TINY, "trainer.max_epochs=3", "weights=null", "baselines={}"]
"""Epochs of two steps; the default recipe, with a moving average of the weights."""


def ended(folder):
    """The metrics and the weights of a completed run."""
    record = run_record.read(folder)
    assert record.status == "completed"
    return record.metrics, weights.read(folder / weights.FILE)["sha256"]


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    done([*SHORT, "hydra.run.dir=run"], folder)
    return ended(folder / "run")


@pytest.mark.parametrize(
    "stops", [[1, 3], [2], ["test"]], ids=["two ends of epochs", "mid epoch", "test"]
)
def test_stopped_run_resumed_by_same_command_gives_same_weights(
    unbroken, tmp_path, monkeypatch, stops
):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it

    def stop_at(place):
        if place in stops:
            stops.remove(place)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(
        Experiment, "on_before_zero_grad", lambda self, _: stop_at(self.global_step)
    )
    monkeypatch.setattr(Experiment, "on_test_start", lambda _: stop_at("test"))
    command, number = [*SHORT, "out=stopped"], len(stops)
    done = [6 if place == "test" else place + 1 for place in stops]
    for stop in range(number):
        status, _, err = call([*command, f"hydra.run.dir=stopped/{stop}"], tmp_path)
        assert (status, "Traceback" in err) == (130, False), err
        assert "ckpt_path=" in err
        assert run_record.read(tmp_path / "stopped" / str(stop)).status == "interrupted"
        kept = tmp_path / "stopped" / str(stop) / "checkpoints" / "last.ckpt"
        assert torch.load(kept, weights_only=True)["global_step"] == done[stop]
        command = [*SHORT, "out=stopped", "ckpt_path=last"]
    status, out, err = call([*command, f"hydra.run.dir=stopped/{number}"], tmp_path)
    assert (status, "Warm start" in out) == (0, False), err
    last = run_record.read(tmp_path / "stopped" / str(number))
    assert last.resumed_from == f"stopped/{number - 1}/checkpoints/last.ckpt"
    assert ended(tmp_path / "stopped" / str(number)) == unbroken
