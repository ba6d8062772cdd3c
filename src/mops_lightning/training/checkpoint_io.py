"""How checkpoints are written."""

from pathlib import Path
from typing import Any

from lightning.fabric.plugins import TorchCheckpointIO

from mops_lightning.zoo.weights import write_plain


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
            checkpoint: as Lightning makes it.
            path: of a local file.
            storage_options: not used.
        """
        write_plain(path, checkpoint)
