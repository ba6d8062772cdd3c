"""Parsers in another process."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from mops_lightning import filesystem
from mops_lightning.data.formats import isolated as module
from mops_lightning.data.formats.isolated import isolated
from mops_lightning.errors import UserError


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "a.laz"
    path.write_text("1 2 3")
    return path


def parse(path, kind="good"):
    """Read a file well, with an error, for ever, with too much memory, or die."""
    if kind == "wrong":
        raise ValueError("no points")
    if kind == "abort":
        os.abort()
    if kind == "hang":
        time.sleep(60)
    if kind == "eat":
        np.ones(filesystem.MEMORY + (1 << 28), np.uint8)
    print("a parser's remark")
    return os.getpid()


def test_isolated_runs_in_one_other_process(path, capfd):
    first, second = isolated(parse, path), isolated(parse, path)
    assert first == second != os.getpid()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("wrong", "is broken: ValueError: no points"),
        ("abort", "is broken, or too large .* died"),
        ("eat", "is broken, or too large"),
    ],
)
def test_isolated_failure_is_one_error(kind, message, path):
    with pytest.raises(UserError, match=rf"a\.laz {message}"):
        isolated(parse, path, kind)
    assert isolated(parse, path) != os.getpid()


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="the system has no timer")
def test_isolated_slow_parser_is_ended(path, monkeypatch):
    isolated(parse, path)  # starts the process
    monkeypatch.setattr(module, "SECONDS", 1.0)
    with pytest.raises(UserError, match=r"a\.laz is broken: reading it took more than 1 s"):
        isolated(parse, path, "hang")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
# Python 3.12 warns of a fork in a process with threads; the child here uses none.
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_isolated_in_forked_process_has_a_reader_of_its_own(path):
    """As workers of a data loader are: two that share a reader would get each other's results."""
    before = isolated(parse, path)
    context = multiprocessing.get_context("fork")
    readers = context.SimpleQueue()

    child = context.Process(target=lambda: readers.put(isolated(parse, path)))
    child.start()
    child.join(60)

    assert child.exitcode == 0
    assert readers.get() not in (before, os.getpid())
    assert isolated(parse, path) == before


def test_isolated_process_ends_with_its_script(path):
    """Also in a script without a guard, whose end prints nothing."""
    script = (
        "from pathlib import Path\n"
        "from mops_lightning.data.formats.isolated import isolated\n"
        "from tests.data.formats.test_isolated import parse\n"
        f"print(isolated(parse, Path({str(path)!r})))"
    )
    command = [sys.executable, "-W", "error", "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    with pytest.raises(ProcessLookupError):
        os.kill(int(done.stdout), 0)
