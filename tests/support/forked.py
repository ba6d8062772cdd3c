"""The command line in a fork of this process, which has imported torch and Lightning already."""

import os
import runpy
import signal
import sys
import tempfile
import traceback
import warnings
from threading import Timer

import torch

from tests.support.command_line import start, variables


def start_fork(arguments, folder):
    """Begin in a process of its own, without the seconds that a new one spends on its imports.

    Returns:
        What ``command_line.start`` returns, which this is where a fork could not use threads.
    """
    if not hasattr(os, "fork") or torch.get_num_threads() > 1:
        return start(arguments, folder)
    return Forked(arguments, folder)


class Forked:
    """A child process; the part of ``subprocess.Popen`` that tests use."""

    def __init__(self, arguments, folder):
        reader, writer = os.pipe()
        self.errors = tempfile.TemporaryFile("w+")  # noqa: SIM115, read by communicate
        self.returncode = None
        with warnings.catch_warnings():
            # Python 3.12 warns of it in processes with threads, of which nothing is used here.
            warnings.filterwarnings("ignore", ".*multi-threaded.*", DeprecationWarning)
            self.pid = os.fork()
        if self.pid == 0:
            os.dup2(writer, 1)
            os.dup2(self.errors.fileno(), 2)
            os._exit(_run(arguments, folder))
        os.close(writer)
        self.stdout = os.fdopen(reader)

    def send_signal(self, number):
        os.kill(self.pid, number)

    def communicate(self, timeout):
        """Wait for its end; kill it after ``timeout`` seconds."""
        timer = Timer(timeout, self.send_signal, [signal.SIGKILL])
        timer.start()
        out = self.stdout.read()
        _, status = os.waitpid(self.pid, 0)
        timer.cancel()
        self.stdout.close()
        self.returncode = os.waitstatus_to_exitcode(status)
        with self.errors:
            self.errors.seek(0)
            return out, self.errors.read()


def _run(arguments, folder):
    """Do what ``python -m mops_lightning`` does, and return its exit status."""
    sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1) for number in (1, 2))
    status = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.chdir(folder)
        os.environ.update(variables(folder), HYDRA_FULL_ERROR="")
        sys.argv[1:] = arguments
        runpy.run_module("mops_lightning", run_name="__main__", alter_sys=True)
        status = 0
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    return status
