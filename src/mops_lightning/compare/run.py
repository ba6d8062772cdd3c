"""Sampling a file by several methods, with time and memory."""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.compare.measures import Measures, Reference
from mops_lightning.compare.methods import FPS
from mops_lightning.data.formats.errors import check_size
from mops_lightning.data.formats.registry import read
from mops_lightning.data.formats.table import Table
from mops_lightning.downsample_files.job import sampled, sampler_of
from mops_lightning.downsample_files.scene import sample_table
from mops_lightning.downsample_files.settings import Settings
from mops_lightning.downsample_files.tiled import ROW
from mops_lightning.errors import UserError
from mops_lightning.samplers.base import Sampler

STATM = Path("/proc/self/statm")
"""Where Linux reports the memory of this process."""


@dataclass(frozen=True)
class Result:
    """One method on one file."""

    method: str
    rows: NDArray[np.int64]
    seconds: float
    megabytes: float | None
    measures: Measures


@dataclass(frozen=True)
class FileResult:
    """All methods on one file."""

    path: Path
    table: Table
    results: list[Result]
    thin: int
    spacing: float


@dataclass
class Peak:
    """The most memory in use since the start, in bytes; None where it is not known."""

    start: int | None
    most: int = 0
    done: threading.Event = field(default_factory=threading.Event)

    @property
    def megabytes(self) -> float | None:
        """The growth since the start."""
        return None if self.start is None else max(self.most - self.start, 0) / 2**20


def compare_file(path: Path, methods: dict[str, Settings], seed: int) -> FileResult:
    """Sample a file by all methods and measure the samples.

    Args:
        path: the file.
        methods: settings by name; all with the same ``m`` and with ``keep_attributes``; ``fps`` is
            one of them.
        seed: of a mesh's points and of the points at which the samples are measured.

    Raises:
        UserError: the file holds no usable cloud, or too few points.
    """
    first = methods[FPS]
    m = first.m or 0
    table = read(path, first.surface or max(10_000, 8 * m), seed).finite()
    check_size(path, len(table.points), m)
    found = {}
    for name, settings in methods.items():
        sampler = sampler_of(settings)
        _warm_up(path, table, sampler, settings)
        found[name] = _timed(path, table, sampler, settings)
    reference = Reference.of(table, found[FPS][0], seed)
    results = [
        Result(name, rows, seconds, megabytes, reference.measure(rows))
        for name, (rows, seconds, megabytes) in found.items()
    ]
    return FileResult(path, table, results, int(reference.thin.sum()), reference.spacing)


def _warm_up(path: Path, table: Table, sampler: Sampler, settings: Settings) -> None:
    """Sample a few points, so that imports and compilation are in no method's time."""
    few = np.random.default_rng(0).permutation(len(table.points))[: 2 * (settings.m or 0)]
    # A part may be unusable where the whole is not, such as one of equal points.
    with suppress(UserError):
        _rows(path, table.take(few), sampler, settings)


def _timed(
    path: Path, table: Table, sampler: Sampler, settings: Settings
) -> tuple[NDArray[np.int64], float, float | None]:
    start = time.perf_counter()
    with peak_memory() as peak:
        rows = _rows(path, table, sampler, settings)
    return rows, time.perf_counter() - start, peak.megabytes


def _rows(path: Path, table: Table, sampler: Sampler, settings: Settings) -> NDArray[np.int64]:
    if settings.tiled:
        return sample_table(path, table, sampler, settings)[0].row
    numbered = Table(table.points, {**table.columns, ROW: np.arange(len(table.points))})
    rows: NDArray[np.int64] = sampled(
        path, numbered, sampler, settings.m or sampler.m, settings
    ).columns[ROW]
    return rows


@contextmanager
def peak_memory(interval: float = 0.005) -> Iterator[Peak]:
    """Watch this process's memory; torch's memory is not seen by Python's own tools."""
    peak = Peak(_resident())
    if peak.start is None:
        yield peak
        return

    def watch() -> None:
        while not peak.done.wait(interval):
            peak.most = max(peak.most, _resident() or 0)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield peak
    finally:
        peak.most = max(peak.most, _resident() or 0)
        peak.done.set()
        thread.join()


def _resident() -> int | None:
    try:
        return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return None
