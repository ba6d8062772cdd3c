import ctypes
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.callbacks.progress.progress_bar import get_standard_metrics

from mops_lightning.config.compose import compose
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.run import trainer as module
from tests.support.command_line import TINY
from tests.support.full_disk import full_disk
from tests.support.training import small_dataset


def test_make_trainer_writes_checkpoints_atomically_and_shows_no_version(tmp_path):
    experiment = Experiment(Classification(PointNetVanilla(3), 3), learn="task")
    cfg = compose([*(one for one in TINY if not one.startswith("logger")), "logger=tensorboard"])
    trainer = module.make_trainer(cfg, tmp_path, small_dataset(), experiment, clouds=8)
    assert isinstance(trainer.strategy.checkpoint_io, module.AtomicCheckpointIO)
    assert trainer.logger is not None
    assert trainer.logger.log_dir is not None
    assert Path(trainer.logger.log_dir) == tmp_path
    assert "v_num" not in get_standard_metrics(trainer)


def test_save_checkpoint_on_full_disk_keeps_previous(tmp_path):
    path = tmp_path / "checkpoints" / "last.ckpt"
    module.AtomicCheckpointIO().save_checkpoint({"epoch": 1}, path)
    with full_disk(), pytest.raises(OSError, match="too large"):
        module.AtomicCheckpointIO().save_checkpoint({"big": torch.zeros(9999)}, path)
    assert torch.load(path) == {"epoch": 1}
    assert [one.name for one in path.parent.iterdir()] == ["last.ckpt"]


def test_save_checkpoint_does_not_use_tmpdir(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    module.AtomicCheckpointIO().save_checkpoint({"epoch": 2}, tmp_path / "last.ckpt")
    assert torch.load(tmp_path / "last.ckpt") == {"epoch": 2}


@pytest.mark.parametrize(("platform", "options"), [("linux", 3), ("win32", 0)])
def test_keep_freed_memory_sets_options_of_linux(monkeypatch, platform, options):
    called = []
    library = SimpleNamespace(mallopt=lambda *option: called.append(option))
    monkeypatch.setattr(ctypes, "CDLL", lambda name: library)
    monkeypatch.setattr(sys, "platform", platform)
    module.keep_freed_memory()
    assert len(called) == options


def test_clouds_to_draw_spreads_over_classes_that_have_test_clouds():
    dataset = small_dataset()
    chosen, names = module.clouds_to_draw(dataset, 2)
    assert names == ["long", "round"]
    assert dataset.test.labels[chosen].tolist() == [0, 2]
    assert chosen.tolist() == [0, 2]  # the first of each class
    assert module.clouds_to_draw(dataset, 9)[1] == ["long", "tall", "round"]
    assert module.clouds_to_draw(dataset, 1)[1] == ["long"]
    assert module.clouds_to_draw(dataset, 0)[1] == []
    test = dataset.test.take(dataset.test.labels != 0)
    chosen, names = module.clouds_to_draw(replace(dataset, test=test), 3)
    assert (names, test.labels[chosen].tolist()) == (["tall", "round"], [1, 2])
