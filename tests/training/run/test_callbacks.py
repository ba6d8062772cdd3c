"""The callbacks group: standard ones, one left out, one added."""

import sys
import time
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint, RichProgressBar

from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.training.run.callbacks import (
    DEFAULT_CALLBACKS,
    CPUTime,
    EpochLines,
    build_callbacks,
    progress,
)
from mops_lightning.training.run.pictures import CloudVisualization, _Drawn
from mops_lightning.zoo import weights
from tests.support.command_line import TINY, done, job, runs

STOPPING = [
    "+callbacks.early._target_=lightning.pytorch.callbacks.EarlyStopping",
    "+callbacks.early.monitor=train/mean_loss",
    "+callbacks.early.divergence_threshold=-1",  # stops after the first epoch
    "+callbacks.early.check_on_train_epoch_end=true",
]


def build_from(overrides, tmp_path):
    nodes = compose(overrides).callbacks
    offered = {"folder": tmp_path, "checkpoint": tmp_path / "last.ckpt", "score": "accuracy"}
    return build_callbacks(nodes, offered, logged=False)


def test_without_logger_and_pictures_two_are_built_if_none_is_left_out(tmp_path):
    assert set(compose().callbacks) == set(DEFAULT_CALLBACKS)
    assert [type(one) for one in build_from([], tmp_path)] == [ModelCheckpoint, EpochLines]
    made = build_from(["callbacks.progress=null"], tmp_path)
    assert [type(one) for one in made] == [ModelCheckpoint]


@pytest.mark.parametrize("target", ["torch.nn.ReLU", None])
def test_node_of_no_callback_is_refused(target, tmp_path):
    given = [] if target is None else [f"+callbacks.mine._target_={target}"]
    with pytest.raises(
        UserError, match=r"callbacks\.mine: (torch.nn.ReLU must return|give its class)"
    ):
        build_from([*given, "+callbacks.mine.inplace=true"], tmp_path)


def test_early_stopping_ends_the_run_but_not_the_pretraining(tmp_path):
    settings = ["trainer.max_epochs=3", "epochs.task=2", "callbacks.checkpoint=null"]
    tiny = [one for one in TINY if "epochs" not in one]
    out = done([*tiny, *settings, *STOPPING], tmp_path)
    assert out.count("epoch 2/2") == 1
    assert out.count("epoch 1/3") == 1
    assert "epoch 2/3" not in out
    (run,) = runs(tmp_path)
    assert not (run / "checkpoints").exists()


def test_epoch_lines_show_validation_of_their_own_epoch_only(tmp_path):
    tiny = [one for one in TINY if "max_epochs" not in one]
    every = ["trainer.max_epochs=4", "val_fraction=0.25", "+trainer.check_val_every_n_epoch=2"]

    out = done([*tiny, *every, "weights=null"], tmp_path)

    lines = [line for line in out.splitlines() if line.startswith("epoch ")]
    assert ["val/generated/accuracy" in line for line in lines] == [False, True, False, True]


def test_pictures_and_a_logger_change_no_weight(tmp_path):
    settings = ["weights=null", "trainer.max_epochs=2"]
    job(tmp_path / "plain", *settings)

    job(tmp_path / "drawn", *settings, "pictures=1", "logger=tensorboard")

    plain, drawn = (weights.read(tmp_path / run / weights.FILE) for run in ("plain", "drawn"))
    assert drawn["sha256"] == plain["sha256"]
    assert (tmp_path / "drawn" / "pictures").is_dir()


@pytest.mark.parametrize(
    "length",
    [
        ["trainer.max_epochs=-1", "+trainer.max_steps=40"],
        ["trainer.max_epochs=-1", "+trainer.max_steps=20", "+trainer.accumulate_grad_batches=2"],
    ],
)
def test_pictures_are_drawn_ten_times_in_a_training_of_twenty_epochs(length, tmp_path, monkeypatch):
    drawn = []

    def note(self, trainer, module, scores):
        if scores is None:
            drawn.append(trainer.current_epoch)
        return _Drawn({}, torch.zeros(1, 1, 3), {}, [])

    monkeypatch.setattr(CloudVisualization, "_draw", note)

    job(tmp_path / "run", "weights=null", "pictures=1", "logger=tensorboard", *length)

    assert drawn == [0, 2, 4, 6, 8, 10, 12, 14, 16, 18]


def shown_epoch(**changes):
    """A trainer after its first epoch, as far as the lines of epochs read it."""
    metrics = {
        "val/generated/accuracy": torch.tensor(0.5),
        "val/generated/mean_class_accuracy": torch.tensor(0.25),
        "train/generated/accuracy": torch.tensor(0.75),
        "train/mean_loss": torch.tensor(1.25),
    }
    facts = {
        "callback_metrics": metrics,
        "current_epoch": 0,
        "is_global_zero": True,
        "max_epochs": 3,
        "sanity_checking": False,
    }
    return SimpleNamespace(**{**facts, **changes})


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({}, "epoch 1/3  val/generated/accuracy 0.5000  train/mean_loss 1.2500\n"),
        ({"max_epochs": -1}, "epoch 1  val/generated/accuracy 0.5000  train/mean_loss 1.2500\n"),
        ({"current_epoch": 2, "sanity_checking": True}, "epoch 3/3  train/mean_loss 1.2500\n"),
        ({"is_global_zero": False}, ""),
    ],
)
def test_epoch_lines_show_the_loss_and_the_score_of_the_first_process(changes, line, capsys):
    trainer: Any = shown_epoch(**changes)
    module: Any = None
    lines = EpochLines("accuracy")

    lines.on_validation_end(trainer, module)
    lines.on_train_epoch_end(trainer, module)

    assert capsys.readouterr().out == line


def test_cpu_time_adds_the_process_time_of_all_attempts(monkeypatch):
    clock = iter([5.0, 7.5, 9.0])
    monkeypatch.setattr(time, "process_time", lambda: next(clock))
    trainer: Any = None
    counter = CPUTime()
    counter.load_state_dict({"seconds": 100.0})

    assert counter.seconds == 100.0
    counter.on_train_start(trainer, trainer)
    assert counter.state_dict() == {"seconds": 102.5}
    counter.on_train_end(trainer, trainer)
    assert counter.seconds == 104.0


@pytest.mark.parametrize(("is_terminal", "kind"), [(True, RichProgressBar), (False, EpochLines)])
def test_progress_is_a_bar_on_a_terminal_only(is_terminal, kind, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: is_terminal)

    assert type(progress("accuracy")) is kind


@pytest.mark.parametrize(("logged", "number"), [(True, 1), (False, 0)])
def test_learning_rate_is_watched_where_there_is_a_logger(logged, number, tmp_path):
    offered = {"folder": tmp_path, "checkpoint": tmp_path / "last.ckpt", "score": "accuracy"}

    made = build_callbacks(compose([]).callbacks, offered, logged=logged)

    assert len([one for one in made if isinstance(one, LearningRateMonitor)]) == number
