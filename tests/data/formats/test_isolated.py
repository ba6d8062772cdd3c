"""Parsers in another process."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

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
    monkeypatch.setattr(module, "SECONDS", 0.25)
    monkeypatch.setattr(module, "BYTES_PER_SECOND", 5 / 0.75)  # of five bytes
    with pytest.raises(UserError, match=r"a\.laz is broken: reading it took more than 1 s"):
        isolated(parse, path, "hang")


def content(path):
    return path.read_text()


def test_isolated_reads_relative_paths_from_the_callers_current_folder(tmp_path, monkeypatch):
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "a.xyz").write_text(name)
        monkeypatch.chdir(folder)

        assert isolated(content, Path("a.xyz")) == name


@pytest.mark.skipif(module.resource is None, reason="the system has no limits")
def test_limits_of_a_call_end_with_it():
    resource = module.resource
    before = resource.getrlimit(resource.RLIMIT_DATA)

    with module._limited(1000.0, 2**50):
        during = signal.getitimer(signal.ITIMER_REAL)[0]
        limit = resource.getrlimit(resource.RLIMIT_DATA)[0]

    assert 900 < during <= 1000
    assert limit == 2**50
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


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
