import tempfile

import pytest
import torch

from mops_lightning.training.checkpoint_io import AtomicCheckpointIO


class Unwritable:
    """Fails in the middle of writing, as a full disk does."""

    def __reduce__(self):
        raise OSError("no space left on device")


def test_save_checkpoint_error_keeps_previous(tmp_path):
    path = tmp_path / "checkpoints" / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint({"epoch": 1}, path)
    with pytest.raises(OSError, match="no space left"):
        AtomicCheckpointIO().save_checkpoint({"big": torch.zeros(9999), "bad": Unwritable()}, path)
    assert torch.load(path) == {"epoch": 1}
    assert [one.name for one in path.parent.iterdir()] == ["last.ckpt"]


def test_save_checkpoint_does_not_use_tmpdir(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    AtomicCheckpointIO().save_checkpoint({"epoch": 2}, tmp_path / "last.ckpt")
    assert torch.load(tmp_path / "last.ckpt") == {"epoch": 2}
