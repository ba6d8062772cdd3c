"""Runs that are stopped and resumed by the same command."""

import signal

import pytest
import torch

from mops_lightning.records import run_record
from mops_lightning.training.experiment import Experiment
from mops_lightning.zoo import weights
from tests.support.command_line import TINY, call, done, unbroken_and_resumed

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
    left = list(stops)

    def stop_at(place):
        if place in left:
            left.remove(place)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(
        Experiment, "on_before_zero_grad", lambda self, _: stop_at(self.global_step)
    )
    monkeypatch.setattr(Experiment, "on_test_start", lambda _: stop_at("test"))
    command = [*SHORT, "out=stopped"]
    for number, place in enumerate(stops):
        folder = tmp_path / "stopped" / str(number)
        status, _, err = call([*command, f"hydra.run.dir=stopped/{number}"], tmp_path)
        assert (status, "Traceback" in err) == (130, False), err
        assert "ckpt_path=" in err
        assert run_record.read(folder).status == "interrupted"
        kept = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
        assert kept["global_step"] == steps_before(place)
        command = [*SHORT, "out=stopped", "ckpt_path=last"]

    status, out, err = call([*command, "hydra.run.dir=stopped/last"], tmp_path)

    assert status == 0, err
    assert "Warm start" not in out
    last = run_record.read(tmp_path / "stopped" / "last")
    assert last.resumed_from == f"stopped/{len(stops) - 1}/checkpoints/last.ckpt"
    assert ended(tmp_path / "stopped" / "last") == unbroken


GRADIENTS = [
    "+callbacks.x._target_=lightning.pytorch.callbacks.GradientAccumulationScheduler",
    "+callbacks.x.scheduling={1:2}",
]
AVERAGE = [
    "+callbacks.x._target_=lightning.pytorch.callbacks.StochasticWeightAveraging",
    "+callbacks.x.swa_lrs=0.01",
    "+callbacks.x.swa_epoch_start=1",
]


@pytest.mark.filterwarnings("ignore:SWA is currently only supported every epoch")
@pytest.mark.parametrize("callback", [GRADIENTS, AVERAGE], ids=["gradients", "average"])
def test_what_a_callback_of_lightning_set_at_the_start_of_an_epoch_is_set_again(
    callback, tmp_path, monkeypatch
):
    def stop_inside(experiment, outputs, batch, batch_idx):
        if (experiment.current_epoch, batch_idx) == (1, 1):
            signal.raise_signal(signal.SIGTERM)

    command = [*SHORT, "batch_size=2", *callback]
    unbroken_and_resumed(command, tmp_path, monkeypatch, "on_train_batch_end", stop_inside)

    assert ended(tmp_path / "resumed") == ended(tmp_path / "unbroken")


def steps_before(place):
    """Return the steps that a run has finished when it is stopped at a place."""
    if place == "test":
        return 6
    return place + 1
