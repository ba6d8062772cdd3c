import tempfile

import pytest
import torch

from mops_lightning.training.run.checkpoint_io import AtomicCheckpointIO
from tests.support.full_disk import full_disk


def test_save_checkpoint_on_full_disk_keeps_previous(tmp_path):
    path = tmp_path / "checkpoints" / "last.ckpt"
    writer = AtomicCheckpointIO()
    writer.save_checkpoint({"epoch": 1}, path)

    with full_disk(), pytest.raises(OSError, match="too large"):
        writer.save_checkpoint({"big": torch.zeros(9999)}, path)

    assert torch.load(path) == {"epoch": 1}
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


def test_save_checkpoint_does_not_use_tmpdir(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    path = tmp_path / "last.ckpt"

    AtomicCheckpointIO().save_checkpoint({"epoch": 2}, path)

    assert torch.load(path) == {"epoch": 2}
