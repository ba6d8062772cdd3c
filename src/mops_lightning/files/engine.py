"""Engines: where the ranges of a file's rows are processed, in this process or by Dask.

Dask instead of Ray, because it is plain Python, small, and runs wherever torch does, and little is
needed here: distribute ranges, and distribute them again when a worker dies.
"""

import logging
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from operator import call
from typing import Any

from rich.progress import track

from mops_lightning.errors import UserError

PATIENCE = 20
"""Seconds to wait for a scheduler and its first worker."""


class Engine:
    """Calls a function for ranges of rows: here, one after the other in this process.

    Args:
        progress: show the progress on a terminal.
    """

    def __init__(self, progress: bool = False) -> None:
        self.progress = progress

    def map(
        self,
        title: str,
        function: Callable[[range], Any],
        row_ranges: list[range],
    ) -> Iterable[Any]:
        """Return ``function(rows)`` for every range of rows, in order.

        Args:
            title: name of the step, for progress and errors.
            function: can be pickled, such as a ``partial`` of a function of a module.
            row_ranges: ranges of rows, which are independent of each other.
        """
        results = map(function, row_ranges)
        if not self.progress:
            return results
        return with_progress(results, title, len(row_ranges))


def with_progress(results: Iterable[Any], title: str, total: int) -> Iterable[Any]:
    """Pass results on, and show the progress on a terminal."""
    hidden = not sys.stdout.isatty()
    return track(results, title, total=total, disable=hidden, transient=True)


@contextmanager
def dask_engine(address: str, progress: bool) -> Iterator["DaskEngine"]:
    """Yield an engine that distributes its work by Dask.

    Args:
        address: of a running scheduler.
        progress: show the progress on a terminal.

    Raises:
        UserError: Dask is not installed, or no scheduler with workers answers at the address.
    """
    try:
        import dask
        import distributed
    except ModuleNotFoundError:
        raise UserError("--cluster needs Dask: pip install 'mops-lightning[cluster]'.") from None
    # Errors say what a user needs to know.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(address, timeout=PATIENCE)
    except (OSError, ValueError, TypeError) as error:
        raise UserError(
            f"--cluster: no Dask scheduler answers at {address} ({type(error).__name__}). Start "
            "one with `dask scheduler`, and `dask worker ADDRESS` on every machine."
        ) from None
    # The net is part of the task graph, so that workers that join later get it.
    with client, dask.config.set({"distributed.admin.large-graph-warning-threshold": "1GB"}):
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise UserError(
                f"--cluster: the scheduler at {address} has no workers. Start some with "
                f"`dask worker {address}`."
            ) from None
        yield DaskEngine(client, progress)


class DaskEngine(Engine):
    """Submits ranges to a Dask client; a range is repeated when its worker dies.

    Args:
        client: a ``distributed.Client``.
        progress: show the progress on a terminal.
    """

    def __init__(self, client: Any, progress: bool = False) -> None:
        super().__init__(progress)
        self.client = client

    def map(
        self,
        title: str,
        function: Callable[[range], Any],
        row_ranges: list[range],
    ) -> Iterator[Any]:
        """See ``Engine.map``.

        Raises:
            UserError: workers die repeatedly, or the scheduler is lost.
        """
        from distributed import CancelledError, KilledWorker
        from distributed.comm import CommClosedError

        try:
            results: Iterable[Any] = self._results(function, row_ranges)
            if self.progress:
                results = with_progress(results, title, len(row_ranges))
            yield from results
        except KilledWorker:
            raise UserError(
                f"--cluster: workers died repeatedly ({title}), perhaps for lack of memory. Try a "
                "smaller --chunk."
            ) from None
        except Exception as error:  # Dask raises several kinds when the connection is lost
            lost = isinstance(error, CancelledError | CommClosedError)
            if not lost and self.client.status == "running":
                raise
            raise UserError(
                f"--cluster: lost the connection to the scheduler ({type(error).__name__}). "
                "Restart it and run the same command again."
            ) from None

    def _results(self, function: Callable[[range], Any], row_ranges: list[range]) -> Iterator[Any]:
        # A task, not scattered data: Dask repeats it when the worker that holds it dies.
        shared = self.client.submit(lambda: function, pure=False)
        functions = [shared] * len(row_ranges)
        futures = self.client.map(call, functions, row_ranges, pure=False)
        futures.reverse()
        while futures:
            yield futures.pop().result()  # workers forget a result that nothing refers to
