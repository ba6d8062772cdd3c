"""Threads, and a pool of worker processes that do not import torch, so that they start fast."""

import os
import signal
import sys
import threading
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context, parent_process


def number_of_threads() -> int:
    """Return torch's number of threads, or that of processors, without importing torch."""
    torch = sys.modules.get("torch")
    if torch is not None:
        threads: int = torch.get_num_threads()
        return threads
    limit = os.environ.get("OMP_NUM_THREADS", "")
    if limit.isdecimal() and int(limit) > 0:
        return int(limit)
    return os.cpu_count() or 1


@cache
def pool(workers: int) -> ProcessPoolExecutor:
    """Return a pool of worker processes that is reused by later calls.

    The processes are spawned, because forking after torch has started threads can deadlock. A
    spawned process imports the main module and the module of its function; the latter should
    therefore not import torch.
    """
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=start_worker)


def start_worker() -> None:
    """Ignore Ctrl-C, which the parent handles, and exit with the parent, even if it is killed."""
    os.environ["POT_BACKEND_DISABLE_PYTORCH"] = "1"  # POT would import torch in every worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    if parent := parent_process():
        parent.join()
        os._exit(1)
