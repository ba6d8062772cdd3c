"""Processes that fail one job only when they die."""

import os
import signal
import time

import numpy as np
import pytest

from mops_lightning import filesystem
from mops_lightning.data.formats import guard
from mops_lightning.files.processes import Died, Processes

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="the system has no timer")


def job(path, kind):
    """Read a file well, for ever, with too much memory, or die."""
    guard.SECONDS = 0.2
    try:
        with guard.limited(path):
            if kind == "abort":
                os.abort()
            if kind == "hang":
                while True:
                    time.sleep(1)
            if kind == "eat":
                np.ones(filesystem.MEMORY + (1 << 28), np.uint8)
    except MemoryError:
        return "too much memory"
    return os.getpid()


def test_processes_bad_files_fail_alone(tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text("1 2 3\n")
    kinds = ["good", "abort", "good", "hang", "eat", "good"]
    processes = Processes(2)
    results = dict(processes.map(job, [(path, kind) for kind in kinds]))
    assert results[1] == Died(signal.SIGABRT)
    assert results[3] == Died(signal.SIGALRM)
    assert results[4] == "too much memory"
    assert all(isinstance(results[place], int) for place in (0, 2, 5))
    again = dict(processes.map(job, [(path, "good")] * 3))
    assert set(again.values()) & set(results.values()), "live processes are used again"


def test_processes_closed_early_end_their_jobs(tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text("1 2 3\n")
    processes = Processes(2)
    results = processes.map(sleep, [(tmp_path / "begun", 0), (tmp_path / "deleted", 60)])
    assert next(results) == (0, None)
    while not (tmp_path / "deleted").exists():
        time.sleep(0.01)
    results.close()
    assert not (tmp_path / "deleted").exists(), "the job's cleaning up was done"


def sleep(path, seconds):
    path.touch()
    try:
        time.sleep(seconds)
    finally:
        path.unlink()
