"""The command line as a user types it, in a process of its own or, quicker, in this one."""

import contextlib
import io
import os
import subprocess
import sys
import warnings
from typing import Any
from unittest.mock import patch

import torch
from hydra.core.global_hydra import GlobalHydra

from mops_lightning.cli.main import main
from mops_lightning.config.compose import compose
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.run.run import run

TINY_ANY_DATA = [
    "trainer=cpu",
    "trainer.max_epochs=1",
    "epochs.task=1",
    "dataset.n_points=64",
    "batch_size=4",
    "m=8",
    "pictures=0",
    "logger=none",
]
"""The settings of the smallest job that do not depend on the dataset."""

TINY = [
    *TINY_ANY_DATA,
    "dataset.train_per_class=4",
    "dataset.test_per_class=3",
    "dataset.classes=[chair,vase,lamp]",
]
"""The smallest job that runs every stage, on procedural shapes."""

SMALL_PCRNET = [
    "task=registration",
    "weights=auto",
    "pretrain_from=null",
    "task.net.feature_channels=[16,32]",
]
"""Registration by a net that is written to disk in no time."""

TINY_WITH_PICTURES = [*TINY, "pictures=2", "logger=tensorboard"]


def start(arguments, folder, **extra):
    """Begin in a new process."""
    env = {**os.environ, **variables(folder), **extra}
    env.pop("HYDRA_FULL_ERROR", None)
    command = [sys.executable, "-m", "mops_lightning", *arguments]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=folder, env=env, stdout=pipe, stderr=pipe, text=True)


def call_anew(arguments, folder, **extra):
    """Run in a new process to its end: exit status and what it printed."""
    process = start(arguments, folder, **extra)
    out, err = process.communicate(timeout=240)
    return process.returncode, out, err


def call(arguments, folder):
    """Run in this process: a new one spends most of its time on importing torch and lightning."""
    out = io.StringIO()
    err = io.StringIO()
    with (
        contextlib.chdir(folder),
        patch.dict(os.environ, {**variables(folder), "HYDRA_FULL_ERROR": ""}),
        patch.object(sys, "argv", ["mops_lightning", *arguments]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        warnings.catch_warnings(),
    ):
        status: Any = 0
        try:
            main()
        except SystemExit as stop:
            status = stop.code
        finally:
            GlobalHydra.instance().clear()
    return status, out.getvalue(), err.getvalue()


def done(arguments, folder):
    """What a command line that succeeds prints."""
    status, out, err = call(arguments, folder)
    assert status == 0, out + err
    return out


def unbroken_and_resumed(arguments, folder, monkeypatch, hook, stop):
    """Train without a break, and again with one stop, into the folders of these names.

    ``stop`` takes the place of a hook of the experiment while the second training is stopped.
    """
    done([*arguments, "hydra.run.dir=unbroken"], folder)
    with monkeypatch.context() as patched:
        patched.setattr(Experiment, hook, stop)
        status, _, err = call([*arguments, "hydra.run.dir=stopped"], folder)
    assert status == 130, err
    done([*arguments, "hydra.run.dir=resumed", "ckpt_path=stopped"], folder)


def refused(arguments, folder):
    """The line in which a command line with a mistake ends."""
    status, out, err = call(arguments, folder)
    assert (status, err.count("\n")) == (2, 1), out + err
    assert err.startswith("mops_lightning: ")
    assert len(err) < 1000
    return err


def runs(folder):
    """Return the folders of all runs below ``outputs``."""
    return sorted(path.parent for path in (folder / "outputs").rglob("result.json"))


def job(folder, *overrides):
    """Run the smallest job with further settings, and a cache beside its folder; its record."""
    chosen = [*TINY, f"cache={folder.parent}/cache", *overrides]
    return run(compose(chosen), folder, chosen)


def variables(folder):
    """Return the environment variables of a command in a folder."""
    # As many threads there as here, for sums depend on it.
    threads = str(torch.get_num_threads())
    return {"MOPS_CACHE": str(folder / "cache"), "COLUMNS": "160", "OMP_NUM_THREADS": threads}
