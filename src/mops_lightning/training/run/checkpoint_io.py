"""Writing checkpoints so that a crash never destroys the previous one."""

import io
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO

from mops_lightning.filesystem import atomic_write
from mops_lightning.training.checkpoint import sealed


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints next to their target and then replaces it.

    Lightning's own writer uses a temporary file in ``TMPDIR``. If that is another file system, the
    last step is a copy, and a kill or a full disk during the copy destroys the previous checkpoint.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None
    ) -> None:
        """Write ``checkpoint`` to ``path``; until it is complete, the previous one stays.

        Args:
            checkpoint: the state, as Lightning collects it.
            path: path of a local file.
            storage_options: not used.
        """
        buffer = io.BytesIO()  # torch.save hides the OSError of a full disk
        torch.save(checkpoint, buffer)
        with atomic_write(path) as temporary:
            temporary.write_bytes(sealed(buffer.getvalue()))
