"""The callbacks group: standard ones, one left out, one added."""

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.training.run.callbacks import DEFAULT_CALLBACKS, EpochLines, build_callbacks
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
