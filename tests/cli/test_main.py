"""The program and its subcommands: help, wrong names, and readers of the output that go away."""

import os
import subprocess
import sys
from importlib.metadata import version

import pytest

from mops_lightning.cli.main import COMMANDS, main
from mops_lightning.records import run_record
from tests.support.command_line import TINY, call, call_anew, refused, runs, start


@pytest.mark.parametrize("name", COMMANDS)
def test_subcommand_help_names_the_subcommand(name, tmp_path):
    status, out, err = call([name, "--help"], tmp_path)
    assert (status, err) == (0, "")
    assert out.startswith(f"usage: mops_lightning {name} [-h]")


@pytest.mark.parametrize(
    "arguments",
    [
        ["report", "nowhere"],
        ["downsample", "nowhere", "out", "--method=fps", "--m=4"],
        ["compare", "nowhere", "--m=4"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_subcommand_error_names_the_subcommand(arguments, tmp_path):
    status, _, err = call(arguments, tmp_path)
    assert status == 2
    assert err.startswith(f"mops_lightning {arguments[0]}: nowhere")


@pytest.mark.parametrize("name", COMMANDS)
def test_subcommand_error_shows_no_control_characters(name, tmp_path):
    status, _, err = call([name, *["\x1b[31m.ply"] * 5, "--nosuch"], tmp_path)
    assert status == 2
    assert "\x1b" not in err


def test_version_is_that_of_the_package(tmp_path):
    status, out, err = call(["--version"], tmp_path)
    assert (status, err) == (0, "")
    assert out == f"mops_lightning {version('mops-lightning')}\n"


def test_waiting_threads_soon_sleep(tmp_path):
    # Imports torch, then ends.
    arguments = ["downsample", "nowhere", "out", "--method=fps", "--m=4"]
    _, _, err = call_anew(arguments, tmp_path, OMP_DISPLAY_ENV="VERBOSE")
    if "GOMP_SPINCOUNT" not in err:
        pytest.skip("torch uses another OpenMP library")
    assert "GOMP_SPINCOUNT = '1000'" in err


@pytest.mark.parametrize(
    ("name", "value", "spins"), [("GOMP_SPINCOUNT", "5", "5"), ("OMP_WAIT_POLICY", "PASSIVE", None)]
)
def test_wait_of_threads_that_the_user_sets_is_kept(name, value, spins, monkeypatch):
    monkeypatch.setattr(os, "environ", {name: value})
    monkeypatch.setattr(sys, "argv", ["mops_lightning", "--version"])
    main()
    assert os.environ.get("GOMP_SPINCOUNT") == spins


@pytest.mark.parametrize(
    ("typed", "near"),
    [("reprot", "'report' or 'export' or 'propagate'"), ("down-sample", "'downsample'")],
)
def test_unknown_subcommand_names_the_nearest(typed, near, tmp_path):
    err = refused([typed, "results"], tmp_path)
    assert f"Did you mean {near}?" in err
    assert "KEY=VALUE" in err


@pytest.mark.parametrize(
    "arguments",
    [
        ["mops_lightning", "--help"],
        ["mops_lightning", "--cfg", "job"],
        ["mops_lightning", "report", "--help"],
    ],
)
def test_closed_pipe_ends_quietly(arguments, tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", *arguments]
    done = subprocess.run(command, cwd=tmp_path, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert done.stderr == b""
    assert done.returncode in (141, 0)  # argparse ignores the error when it prints help


def test_run_whose_reader_ends_stops_quietly(tmp_path):
    """As ``| head -1`` does: the output is closed after the first line."""
    with start([*TINY, "trainer.max_epochs=50"], tmp_path) as process:
        assert process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141
    (run,) = runs(tmp_path)
    record = run_record.read(run)
    assert record.status == "interrupted"
    assert record.error == "BrokenPipeError: [Errno 32] Broken pipe"
