"""Noticing that a worker process of a run on several devices has died."""

import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from lightning.pytorch.strategies.launchers import subprocess_script

from mops_lightning.errors import INTERRUPTED, Interrupted, UserError

Processes = list[subprocess.Popen[Any]]

PATIENCE = 20.0
"""Seconds that a process may wait for a dead one, such as in NCCL, before it is ended."""
POLL = 0.5

AGAIN = "Resume with the same command and ckpt_path=last."

at_end: list[Callable[[str], None]] = []
"""What is called with a text before a waiting process is ended, such as writing the record."""


def watch_workers() -> None:
    """Replace Lightning's observer, which kills this process before it has written its record."""
    subprocess_script._launch_process_observer = _watch


def _watch(child_processes: Processes) -> None:
    threading.Thread(target=_observe, args=(child_processes,), daemon=True).start()


def _observe(processes: Processes) -> None:
    while any(process.poll() != 0 for process in processes):
        if (text := _ended(processes)) is not None:
            for process in processes:
                process.kill()
            time.sleep(PATIENCE)  # a closed connection raises an error in the main thread
            for call in at_end:
                call(text)
            print(f"mops_lightning: interrupted. {text}", flush=True)
            os._exit(INTERRUPTED)
        time.sleep(POLL)


def _ended(processes: Processes) -> str | None:
    """Return what happened to the first worker that ended with an error."""
    for number, process in enumerate(processes, start=1):
        code = process.poll()
        if code:
            how = f"was killed (signal {-code})" if code < 0 else f"ended with status {code}"
            return f"Worker process {number} {how}. {AGAIN}"
    return None


@contextmanager
def dead_workers_reported(trainer: Any) -> Iterator[None]:
    """Turn an error that the death of a worker process caused into one line about it.

    Args:
        trainer: Lightning's; its launcher knows the worker processes.

    Raises:
        Interrupted: a worker was killed or ended with an error.
    """
    try:
        yield
    except (Interrupted, UserError):
        raise
    except Exception:
        processes = getattr(trainer.strategy.launcher, "procs", [])
        # The connection closes before the process has ended.
        end = time.monotonic() + (4 * POLL if processes else 0)
        while (text := _ended(processes)) is None and time.monotonic() < end:
            time.sleep(POLL / 5)
        if text is None:
            raise
        for process in processes:
            process.kill()
        raise Interrupted(text) from None
