"""Dask as the engine: ranges of a file's rows, distributed over processes or machines.

Dask instead of Ray, because it is plain Python, small, and runs wherever torch does, and little is
needed here: distribute ranges, and distribute them again when a worker dies.
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

from mops_lightning.data.formats.cloud_file import CloudFile
from mops_lightning.downsample_files.large import Engine
from mops_lightning.errors import UserError

LOCAL = "local"
PATIENCE = 20
"""Seconds to wait for a scheduler and its first worker."""

AHEAD = 4
"""Ranges per thread that are submitted before the first result is used."""


@contextmanager
def cluster(address: str, workers: int) -> Iterator[Engine]:
    """Yield an engine that distributes its work by Dask.

    Args:
        address: of a running scheduler, or ``local`` for processes on this machine.
        workers: number of local processes.

    Raises:
        UserError: Dask is not installed, or no scheduler with workers answers at the address.
    """
    distributed = _distributed()
    import dask

    # Errors say what a user needs to know.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    # The net is part of the task graph, so that workers that join later get it.
    with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1GB"}):
        if address != LOCAL:
            with _client(distributed, address) as client:
                yield engine_of(client)
            return
        with environment_kept():
            with _no_interrupts():
                # Workers inherit this, so Ctrl-C reaches this process only.
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
    """Restore the environment: Dask sets OMP_NUM_THREADS=1 for its workers in this process too."""
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
        raise UserError("--cluster needs Dask: pip install 'mops-lightning[cluster]'.") from None
    return distributed


@contextmanager
def _client(distributed: Any, address: str) -> Iterator[Any]:
    try:
        client = distributed.Client(address, timeout=PATIENCE)
    except (OSError, ValueError, TypeError) as error:
        raise UserError(
            f"--cluster: no Dask scheduler answers at {address} ({type(error).__name__}). Start "
            "one with `dask scheduler`, and `dask worker ADDRESS` on every machine, or use "
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
    """Return an engine that submits to a client; see ``large.Engine``."""
    from distributed import CancelledError, KilledWorker
    from distributed.comm import CommClosedError

    def engine(
        title: str,
        function: Callable[..., Any],
        cloud: CloudFile,
        row_ranges: list[range],
        *common: Any,
    ) -> Iterator[Any]:
        # Workers may have a different working directory.
        cloud = replace(cloud, path=cloud.path.absolute())
        futures: deque[Any] = deque()
        rest = iter(row_ranges)
        try:
            # Tasks, not scattered data: Dask repeats them when the worker that holds them dies.
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
                f"--cluster: workers died repeatedly at {cloud.path} ({title}), perhaps for lack "
                "of memory. Try a smaller --chunk."
            ) from None
        except Exception as error:  # Dask raises several kinds when the connection is lost
            lost = isinstance(error, CancelledError | CommClosedError)
            if not lost and client.status == "running":
                raise
            raise UserError(
                f"--cluster: lost the connection to the scheduler ({type(error).__name__}). "
                "Restart it and run the same command again."
            ) from None

    return engine


def _same(value: Any) -> Any:
    return value
