"""Processes that share work; without torch, so that they start fast."""

import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context, parent_process


@cache
def pool(workers: int) -> ProcessPoolExecutor:
    """Return processes that stay for the next call.

    They are spawned, for forking a process in which torch has started threads can hang. A spawned
    one imports the main module and that of its function, which therefore should do without torch.
    """
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_start)


def _start() -> None:
    """Leave Ctrl-C to the process that asks, and end when it ends, however it does."""
    os.environ["POT_BACKEND_DISABLE_PYTORCH"] = "1"  # POT would import torch into every worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if parent := parent_process():
        parent.join()
        os._exit(1)
