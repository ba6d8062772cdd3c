"""What a worker process does with a file; it imports torch only when there is one."""

import os
from pathlib import Path
from typing import Any

from mops_lightning.errors import UserError


def attempt(source: Path, target: Path, settings: Any, workers: int | None) -> Any:
    """Downsample one file and return what came of it, or the error.

    Args:
        source: the file.
        target: the file to write.
        settings: see ``job.Settings``.
        workers: among how many processes the cores are shared; None: leave the threads alone.
    """
    from mops_lightning.downsample.job import run

    if workers:
        import torch

        torch.set_num_threads(max((os.cpu_count() or 1) // workers, 1))
    try:
        return run(source, target, settings)
    except UserError as error:
        return error
    except Exception as error:
        return UserError(f"{source}: {type(error).__name__}: {error}.")
