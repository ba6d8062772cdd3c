"""kill -9 at writes and at random moments: the same command again gives the same bits.

A short round in the suite; ``make fuzz`` kills at every write and at random moments.
"""

import contextlib
import io
import multiprocessing
import os
import random
import signal
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from mops_lightning.cli.sweep import run_cell
from mops_lightning.config.compose import compose
from mops_lightning.filesystem import TEMPORARY
from mops_lightning.records import run_record
from mops_lightning.records.run_record import ASIDE
from mops_lightning.training.run.run import run
from mops_lightning.zoo import weights
from tests.support.command_line import TINY

LONG = int(os.environ.get("MOPS_FUZZ", "0"))
"""Command lines of the long round; a tenth of it: kills at random moments; 0: the short round."""
MOST_SECONDS = 300
pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")

# Children of a server that runs no threads and has imported all: a fork of the process of the tests
# would inherit locks that threads of earlier tests held, and could wait for them for ever.
PROCESSES: Any = multiprocessing.get_context("spawn")
if hasattr(os, "fork"):
    PROCESSES = multiprocessing.get_context("forkserver")
    PROCESSES.set_forkserver_preload(["mops_lightning.cli.sweep", __name__])

TWO_EPOCHS = [*TINY, "trainer.max_epochs=2", "epochs.task=2", "baselines={}"]


def single(folder):
    """One run without a pretrained net, resumed where there is a checkpoint."""
    out = folder / "out"
    overrides = [*TWO_EPOCHS, "weights=null", f"out={out}", f"cache={folder}/cache"]
    if any(out.glob("*/checkpoints/last.ckpt")):
        overrides.append("ckpt_path=last")
    earlier_runs = list(out.glob("*"))
    cfg = compose(overrides)
    run(cfg, out / str(len(earlier_runs)), overrides)


def cell(folder):
    """One cell of a sweep, which pretrains its task net."""
    overrides = [*TWO_EPOCHS, f"cache={folder}/cache"]
    cfg = compose(overrides)
    run_cell(cfg, folder / "cell", overrides)


WORK = {"single": single, "cell": cell}


def results(folder):
    """What must be equal, bit for bit."""
    found = {}
    for path in sorted(folder.rglob("weights.safetensors")):
        if ASIDE not in path.parts:
            content = weights.read(path)
            learned = content["config"]["learn"]
            found[learned] = (content["sha256"], content["metrics"])
    statuses = set()
    for path in folder.rglob(run_record.FILE):
        record = run_record.read(path.parent)
        statuses.add(record.status)
    assert "completed" in statuses
    return found


def attempt(folder, work, at_write=0, after=None):
    """Work in a process of its own; kill it before a write, or after some seconds.

    Returns:
        Its exit status, negative if it was killed, and the number of its writes.
    """
    counts = PROCESSES.SimpleQueue()
    child = PROCESSES.Process(target=in_child, args=(folder, work, at_write, counts))
    child.start()
    if after is not None:
        time.sleep(after)
        child.kill()
    child.join(MOST_SECONDS)
    hangs = child.is_alive()
    child.kill()
    child.join()
    assert not hangs, f"{work} did not end within {MOST_SECONDS} s"
    writes = 0
    if child.exitcode == 0:
        writes = counts.get()
    return child.exitcode, writes


def in_child(folder, work, at_write, counts):
    """Work, and send the number of writes."""
    temporary = Path("/dev/shm")
    if not temporary.is_dir():
        temporary = folder
    os.environ["TMPDIR"] = str(temporary)
    writes = count_writes(folder, at_write)
    with contextlib.redirect_stdout(io.StringIO()):
        WORK[work](folder)
    counts.put(len(writes))


def count_writes(folder, kill_at):
    """Note each change of a file below a folder; kill this process before a given one."""
    writes: list[str] = []
    to_write = os.O_WRONLY | os.O_RDWR

    def hook(event, arguments):
        if event == "open":
            flags = arguments[2]
            changes = isinstance(flags, int) and flags & to_write
        else:
            changes = event in ("os.rename", "os.mkdir", "os.remove", "os.chmod", "os.truncate")
        if not changes:
            return
        is_below = str(arguments[0]).startswith(str(folder))
        if is_below:
            writes.append(event)
            if len(writes) == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)
    return writes


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """Results, number of writes and seconds of undisturbed work, by kind."""
    found = {}

    def of(work):
        if work not in found:
            folder = tmp_path_factory.mktemp("unbroken") / work
            folder.mkdir()
            start = time.monotonic()
            status, writes = attempt(folder, work)
            seconds = time.monotonic() - start
            assert status == 0
            found[work] = (results(folder), writes, seconds)
        return found[work]

    return of


def check(folder, work, want, **kill):
    folder.mkdir()
    status, _ = attempt(folder, work, **kill)
    assert status in (0, -signal.SIGKILL)
    if status:
        status_of_second, _ = attempt(folder, work)
        assert status_of_second == 0
    assert results(folder) == want, kill
    # A single run that was killed has a folder of its own, which no later run uses.
    if work != "single":
        left = list(folder.rglob(f"{TEMPORARY}*"))
        assert left == [], kill


@pytest.mark.parametrize("work", WORK)
def test_kill_at_write_same_command_gives_same_bits(unbroken, tmp_path, work):
    want, writes, _ = unbroken(work)
    assert want
    assert writes > 4
    numbers = [2 * writes // 3]
    if LONG:
        numbers = list(range(1, writes + 1))
    for number in numbers:
        folder = tmp_path / str(number)
        check(folder, work, want, at_write=number)


@pytest.mark.skipif(not LONG, reason="the long round: make fuzz")
@pytest.mark.parametrize("work", WORK)
def test_kill_at_random_moment_same_command_gives_same_bits(unbroken, tmp_path, work):
    want, _, seconds = unbroken(work)
    rng = random.Random(LONG)
    kills = max(LONG // 10, 1)
    for number in range(kills):
        folder = tmp_path / str(number)
        moment = 0.01 + rng.random() * seconds
        check(folder, work, want, after=moment)
