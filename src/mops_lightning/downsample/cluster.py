"""Dask as the engine: row_ranges of a file read and worked on by several processes or machines.

Dask was taken rather than Ray because it is plain Python, small, and runs wherever torch does; what
it has to do here is little: hand out row_ranges, and hand them out again when a worker dies.
"""

import logging
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from mops_lightning.downsample.formats.cloud_file import CloudFile
from mops_lightning.downsample.large import Engine
from mops_lightning.errors import UserError

LOCAL = "local"
PATIENCE = 20
"""Seconds to wait for a scheduler and its first worker."""

AHEAD = 4
"""Stretches per thread that are handed out before the first of them is put together."""


@contextmanager
def cluster(address: str, workers: int) -> Iterator[Engine]:
    """Give an engine whose work is done by Dask.

    Args:
        address: of a running scheduler, or ``local`` for processes of this machine.
        workers: how many processes, if local.

    Raises:
        UserError: Dask is not installed, or there is no scheduler with workers at the address.
    """
    distributed = _distributed()
    import dask

    # What is worth telling a user is told by errors.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    # The net is sent as part of a task's description, for workers that come later.
    with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1GB"}):
        if address != LOCAL:
            with _client(distributed, address) as client:
                yield engine_of(client)
            return
        with environment_kept():
            with _no_interrupts():
                # So that Ctrl-C reaches this process alone, and not the workers that it starts.
                processes = distributed.LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    dashboard_address=":0",
                    silence_logs=logging.CRITICAL,
                )
            with processes, distributed.Client(processes) as client:
                yield engine_of(client)


@contextmanager
def environment_kept() -> Iterator[None]:
    """Undo what Dask sets for its workers: OMP_NUM_THREADS=1 would hold for what comes later."""
    before = dict(os.environ)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def _no_interrupts() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _distributed() -> Any:
    try:
        import distributed
    except ModuleNotFoundError:
        raise UserError(
            "--cluster needs a package that is not here: pip install 'mops-lightning[cluster]'."
        ) from None
    return distributed


@contextmanager
def _client(distributed: Any, address: str) -> Iterator[Any]:
    try:
        client = distributed.Client(address, timeout=PATIENCE)
    except (OSError, ValueError, TypeError) as error:
        raise UserError(
            f"--cluster: no Dask scheduler answers at {address} ({type(error).__name__}). Start "
            "one with `dask scheduler`, and `dask worker ADDRESS` on every machine; or take "
            "--cluster local."
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise UserError(
                f"--cluster: the scheduler at {address} has no workers. Start some with "
                f"`dask worker {address}`."
            ) from None
        yield client


def engine_of(client: Any) -> Engine:
    """Make an engine of a client; see ``large.Engine``."""
    from distributed import CancelledError, KilledWorker
    from distributed.comm import CommClosedError

    def engine(
        title: str,
        function: Callable[..., Any],
        cloud: CloudFile,
        row_ranges: list[range],
        *common: Any,
    ) -> Iterator[Any]:
        # Workers may have another working directory.
        cloud = replace(cloud, path=cloud.path.absolute())
        futures: deque[Any] = deque()
        rest = iter(row_ranges)
        try:
            # As tasks, not scattered: they are done again when the worker that has them dies.
            shared = [client.submit(_same, value, pure=False) for value in common]
            ahead = AHEAD * max(sum(client.nthreads().values()), 1)
            while True:
                while len(futures) < ahead and (rows := next(rest, None)) is not None:
                    futures.append(client.submit(function, cloud, rows, *shared, pure=False))
                if not futures:
                    return
                yield futures.popleft().result()
        except KilledWorker:
            raise UserError(
                f"--cluster: workers died again and again over {cloud.path} ({title}), perhaps for "
                "want of memory: try a smaller --chunk."
            ) from None
        except Exception as error:  # Dask has many ways to say so
            lost = isinstance(error, CancelledError | CommClosedError)
            if not lost and client.status == "running":
                raise
            raise UserError(
                f"--cluster: the scheduler has gone ({type(error).__name__}). Start it again, and "
                "the same command."
            ) from None

    return engine


def _same(value: Any) -> Any:
    return value
