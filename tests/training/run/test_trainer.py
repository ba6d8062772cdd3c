import ctypes
import sys
import tempfile
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
    settings = [setting for setting in TINY if setting != "logger=none"]
    cfg = compose([*settings, "logger=tensorboard"])

    trainer = module.make_trainer(cfg, tmp_path, small_dataset(), experiment, clouds=8)

    assert isinstance(trainer.strategy.checkpoint_io, module.AtomicCheckpointIO)
    assert trainer.logger is not None
    assert trainer.logger.log_dir is not None
    assert Path(trainer.logger.log_dir) == tmp_path
    assert "v_num" not in get_standard_metrics(trainer)


def test_save_checkpoint_on_full_disk_keeps_previous(tmp_path):
    path = tmp_path / "checkpoints" / "last.ckpt"
    writer = module.AtomicCheckpointIO()
    writer.save_checkpoint({"epoch": 1}, path)

    with full_disk(), pytest.raises(OSError, match="too large"):
        writer.save_checkpoint({"big": torch.zeros(9999)}, path)

    assert torch.load(path) == {"epoch": 1}
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


def test_save_checkpoint_does_not_use_tmpdir(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    path = tmp_path / "last.ckpt"

    module.AtomicCheckpointIO().save_checkpoint({"epoch": 2}, path)

    assert torch.load(path) == {"epoch": 2}


@pytest.mark.parametrize(("platform", "options"), [("linux", 3), ("win32", 0)])
def test_keep_freed_memory_sets_options_of_linux(monkeypatch, platform, options):
    called = []
    library = SimpleNamespace(mallopt=lambda *option: called.append(option))
    monkeypatch.setattr(ctypes, "CDLL", lambda name: library)
    monkeypatch.setattr(sys, "platform", platform)

    module.keep_freed_memory()

    assert len(called) == options
