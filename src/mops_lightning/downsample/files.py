"""What a worker process does with a file; it imports torch only when there is one."""

import os
from pathlib import Path
from typing import Any

from mops_lightning.errors import UserError


def attempt(
    source: Path, target: Path, settings: Any, workers: int | None, engine: Any = None
) -> Any:
    """Downsample one file and return what came of it, or the error.

    Args:
        source: the file.
        target: the file to write.
        settings: see ``job.Settings``.
        workers: among how many processes the cores are shared; None: leave the threads alone.
        engine: what works on the chunks of a file, see ``large.Engine``; None: this process.
    """
    from mops_lightning.downsample.job import run
    from mops_lightning.downsample.large import in_turn

    if workers:
        import torch

        torch.set_num_threads(max((os.cpu_count() or 1) // workers, 1))
    try:
        return run(source, target, settings, engine or in_turn)
    except UserError as error:
        return error
    except Exception as error:
        return UserError(f"{source}: {type(error).__name__}: {error}.")
