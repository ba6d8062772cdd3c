"""Trainings that something other than the last epoch has ended, resumed; and stops in a test."""

import os
import signal
from functools import cache

import pytest
from lightning.pytorch.callbacks import Callback

from mops_lightning.records import run_record
from mops_lightning.training.experiment import Experiment
from mops_lightning.zoo import weights
from tests.support.command_line import TINY, call, done

LONG = [*TINY, "trainer.max_epochs=6", "weights=null", "baselines={}", "val_fraction=0.25"]


class EndsAfterTwoEpochs(Callback):
    """Ends training as any callback of a user may: once, without a state of its own."""

    def on_train_epoch_end(self, trainer, pl_module):
        if trainer.current_epoch == 1:
            trainer.should_stop = True


EARLY = [
    "+callbacks.early._target_=lightning.pytorch.callbacks.EarlyStopping",
    "+callbacks.early.monitor=val/completed/accuracy",
    "+callbacks.early.patience=1",
    "+callbacks.early.min_delta=100",
]
OWN = [f"+callbacks.own._target_={__name__}.EndsAfterTwoEpochs"]
ENDED_BY = {
    "early stopping": (EARLY, 4),
    "a callback": (OWN, 4),
    "a callback, but min_epochs": ([*OWN, "+trainer.min_epochs=4"], 8),
    "max_steps in an epoch": (["+trainer.max_steps=3"], 3),
}
"""Settings, and the steps of the whole training; an epoch has two."""


def ended(folder):
    """What must be equal: steps, weights, scores and the last validation."""
    record = run_record.read(folder)
    assert record.status == "completed"
    digest = weights.read(folder / weights.FILE)["sha256"]
    return digest, record.metrics, record.validation, record.partial


def interrupt(name):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by background jobs
    signal.raise_signal(getattr(signal, name))


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """A function that returns the folder of an unbroken training, which is run once."""

    @cache
    def trained(name):
        settings, _ = ENDED_BY[name]
        folder = tmp_path_factory.mktemp("unbroken")
        done([*LONG, *settings, "hydra.run.dir=run"], folder)
        return folder / "run"

    return trained


@pytest.mark.parametrize("name", ENDED_BY)
def test_ended_training_stopped_in_its_test_is_not_trained_on(
    name, unbroken, tmp_path, monkeypatch
):
    settings, _ = ENDED_BY[name]
    with monkeypatch.context() as patched:
        patched.setattr(Experiment, "on_test_start", lambda _: interrupt("SIGINT"))
        status, _, err = call([*LONG, *settings, "hydra.run.dir=stopped"], tmp_path)
    assert status == 130, err

    out = done([*LONG, *settings, "hydra.run.dir=resumed", "ckpt_path=stopped"], tmp_path)

    assert ended(tmp_path / "resumed") == ended(unbroken(name))
    assert "stopped/checkpoints/last.ckpt: this training had ended after" in out


@pytest.mark.parametrize("name", ["early stopping", "a callback"])
def test_completed_training_resumed_with_more_epochs_keeps_its_ending(name, unbroken, tmp_path):
    settings, steps = ENDED_BY[name]
    first = unbroken(name)
    more = ["hydra.run.dir=again", f"ckpt_path={first}", "trainer.max_epochs=9"]

    out = done([*LONG, *settings, *more], tmp_path)

    assert ended(tmp_path / "again")[:2] == ended(first)[:2]
    assert not run_record.read(tmp_path / "again").lengthened
    assert f"had ended after {steps // 2} epochs" in out


def test_callback_that_asks_before_min_epochs_ends_at_min_epochs_after_a_stop(
    unbroken, tmp_path, monkeypatch
):
    name = "a callback, but min_epochs"
    settings, _ = ENDED_BY[name]

    def stop_in_third_epoch(self, _):
        if self.global_step == 4:
            interrupt("SIGTERM")

    with monkeypatch.context() as patched:
        patched.setattr(Experiment, "on_before_zero_grad", stop_in_third_epoch)
        status, _, err = call([*LONG, *settings, "hydra.run.dir=stopped"], tmp_path)
    assert status == 130, err

    done([*LONG, *settings, "hydra.run.dir=resumed", "ckpt_path=stopped"], tmp_path)

    assert ended(tmp_path / "resumed") == ended(unbroken(name))


def test_training_stopped_twice_after_its_last_validation_keeps_it(tmp_path, monkeypatch):
    settings = [*LONG, "trainer.max_epochs=5", "+trainer.check_val_every_n_epoch=3"]
    done([*settings, "hydra.run.dir=unbroken"], tmp_path)

    def stop_after(steps):
        def stop(self, _):
            if self.global_step == steps:
                interrupt("SIGTERM")

        return stop

    given: list[str] = []
    for steps, run in ((6, "first"), (8, "second")):  # an epoch has two steps
        with monkeypatch.context() as patched:
            patched.setattr(Experiment, "on_before_zero_grad", stop_after(steps))
            status, _, err = call([*settings, f"hydra.run.dir={run}", *given], tmp_path)
        assert status == 130, err
        given = [f"ckpt_path={run}"]

    done([*settings, "hydra.run.dir=resumed", *given], tmp_path)

    assert ended(tmp_path / "resumed") == ended(tmp_path / "unbroken")
    assert run_record.read(tmp_path / "resumed").validation


def stop_in_last_test_batch(self, outputs, batch, number):
    if number + 1 == self.trainer.num_test_batches[0]:
        os.kill(os.getpid(), signal.SIGTERM)


def test_sigterm_in_last_test_batch_interrupts_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(Experiment, "on_test_batch_end", stop_in_last_test_batch, raising=False)

    status, _, err = call([*TINY, "weights=null", "hydra.run.dir=run"], tmp_path)

    assert (status, "Traceback" in err) == (130, False), err
    assert run_record.read(tmp_path / "run").status == "interrupted"
    assert not (tmp_path / "run" / weights.FILE).exists()


def test_sigterm_in_last_test_batch_of_pretraining_starts_no_training(tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(Experiment, "on_test_batch_end", stop_in_last_test_batch, raising=False)
        status, out, err = call([*TINY, "hydra.run.dir=run"], tmp_path)
    assert (status, "Traceback" in err) == (130, False), err
    assert "The same command resumes the task net's training" in err
    assert out.count("epoch 1/1") == 1
    done([*TINY, "hydra.run.dir=unbroken", "cache=other"], tmp_path)

    done([*TINY, "hydra.run.dir=resumed"], tmp_path)

    assert ended(tmp_path / "resumed") == ended(tmp_path / "unbroken")


def test_sigterm_while_data_are_loaded_is_written_to_the_record(tmp_path, monkeypatch):
    place = "mops_lightning.training.run.run._load_data"
    monkeypatch.setattr(place, lambda *_: os.kill(os.getpid(), signal.SIGTERM))

    status, _, err = call([*TINY, "hydra.run.dir=run"], tmp_path)

    assert (status, "Traceback" in err) == (130, False), err
    assert run_record.read(tmp_path / "run").status == "interrupted"
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
