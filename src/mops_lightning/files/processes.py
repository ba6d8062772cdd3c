"""Processes that take one job at a time; one that dies fails its job only and is replaced.

``concurrent.futures`` would give up all jobs when one process dies.
"""

import signal
import sys
from collections.abc import Callable, Generator, Iterable
from functools import cache
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from mops_lightning.data.formats import guard
from mops_lightning.ops.workers import start_worker

GRACE = 2.0
"""Seconds that a process has to delete its temporary file when the user interrupts."""


class Died(NamedTuple):
    """In place of a result: the process of the job died.

    Attributes:
        signal: the number of the signal that ended it, or 0.
    """

    signal: int


@cache
def processes(number: int) -> "Processes":
    """Return processes that later calls use again."""
    return Processes(number)


class Processes:
    """Processes for files: reading has limits in time and memory, see ``data.formats.guard``.

    Args:
        number: how many.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self._idle: list[_Process] = []

    def map(
        self, function: Callable[..., Any], jobs: Iterable[tuple[Any, ...]]
    ) -> Generator[tuple[int, Any], None, None]:
        """Call ``function(*job)`` for every job.

        Yields:
            The number of a job and its result or ``Died``, in the order of completion.
        """
        waiting = iter(enumerate(jobs))
        busy: dict[Connection, tuple[_Process, int]] = {}
        try:
            while True:
                while len(busy) < self.number and (job := next(waiting, None)) is not None:
                    process = self._idle.pop() if self._idle else _Process()
                    process.connection.send((function, job[1]))
                    busy[process.connection] = (process, job[0])
                if not busy:
                    return
                for connection in wait(list(busy)):
                    assert isinstance(connection, Connection)
                    process, place = busy.pop(connection)
                    try:
                        result = connection.recv()
                        self._idle.append(process)
                    except (EOFError, OSError):
                        result = process.died()
                    yield place, result
        finally:
            for process, _ in busy.values():
                process.stop()


class _Process:
    """One process and the connection to it."""

    def __init__(self) -> None:
        # Spawned, because forking after torch has started threads can deadlock.
        context = get_context("spawn")
        self.connection, other = context.Pipe()
        self._process = context.Process(target=_work, args=(other,), daemon=True)
        self._process.start()
        other.close()  # so that the death of the process closes the connection

    def died(self) -> Died:
        self._process.join()
        self.connection.close()
        return Died(max(-(self._process.exitcode or 0), 0))

    def stop(self) -> None:
        self._process.terminate()
        self._process.join(GRACE)
        self._process.kill()
        self.died()


def _work(connection: Connection) -> None:
    """Take jobs until the connection is closed."""
    start_worker()
    # Ends the process by an exception, so that temporary files are deleted.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    guard.turn_on_limits()
    while True:
        try:
            function, job = connection.recv()
        except (EOFError, OSError):
            return
        connection.send(function(*job))
