"""Measuring time and memory; the method behind every figure in benchmarks/."""

import gc
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch.utils.flop_counter import FlopCounterMode

WARM_UP = 2
"""Calls before the first timed one, to fill caches and start thread pools."""

MIN_SECONDS = 0.05
"""Minimum duration of one timing; faster calls are repeated within it."""


clock: Callable[[], float] = time.perf_counter
"""Seconds; ``time.process_time`` where other jobs use the processor."""


class Timing(NamedTuple):
    """Seconds per call over all rounds.

    Attributes:
        median: the median.
        low: the first quartile.
        high: the third quartile.
        rounds: number of rounds.
    """

    median: float
    low: float
    high: float
    rounds: int


def interleaved(cases: Mapping[str, Callable[[], Any]], rounds: int = 7) -> dict[str, Timing]:
    """Time several calls in turn, so that a slow period of the machine affects all of them.

    Args:
        cases: functions to call, by name.
        rounds: number of timings of each.

    Returns:
        Median and quartiles of the seconds per call, by name.
    """
    repeats = {}
    for name, call in cases.items():
        last = MIN_SECONDS
        for _ in range(WARM_UP):
            start = clock()
            _wait(call())
            last = clock() - start
        repeats[name] = max(1, round(MIN_SECONDS / max(last, 1e-9)))
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds):
        for name, call in cases.items():
            gc.collect()
            start = clock()
            for _ in range(repeats[name]):
                result = call()
            _wait(result)
            seconds[name].append((clock() - start) / repeats[name])
    return {name: _timing(values) for name, values in seconds.items()}


def _timing(values: list[float]) -> Timing:
    if len(values) == 1:  # a try: there are no quartiles
        return Timing(values[0], values[0], values[0], 1)
    low, _, high = statistics.quantiles(values, n=4, method="inclusive")
    return Timing(statistics.median(values), low, high, len(values))


def _wait(result: Any) -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def flops(call: Callable[[], Any]) -> int:
    """Count the floating point operations of a call's matrix products (2 per multiply-add)."""
    with FlopCounterMode(display=False) as counter:
        call()
    return counter.get_total_flops()


def ceiling(rounds: int = 7) -> dict[str, float]:
    """Measure the machine's peak: matrix products, and copies larger than the caches.

    Returns:
        ``flops``: float32 multiply-adds per second, times two, of products of 2048 × 2048;
        ``bytes``: bytes read and written per second by copying 256 MiB.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    left, right = (torch.randn(2048, 2048, device=device) for _ in range(2))
    source = torch.zeros(2**26, device=device)
    target = torch.zeros_like(source)
    found = interleaved(
        {"product": lambda: left @ right, "copy": lambda: target.copy_(source)}, rounds
    )
    return {
        "flops": 2 * 2048**3 / found["product"].median,
        "bytes": 2 * source.nbytes / found["copy"].median,
    }


PEAK = """
import re
import sys
import time
from pathlib import Path
sys.path[:0] = {path!r}
import torch
torch.set_num_threads({threads})
{setup}
def status(name):
    text = Path("/proc/self/status").read_text()
    return int(re.search(name + ":[^0-9]*([0-9]+)", text)[1]) * 1024
Path("/proc/self/clear_refs").write_text("5")  # getrusage would include the parent's peak
before = status("VmRSS")
start = time.perf_counter()
{call}
print(time.perf_counter() - start)
print(status("VmHWM") - before)
"""


def peak_memory(setup: str, call: str) -> tuple[int, float]:
    """Run a statement in a new process; return the growth of its peak memory in bytes, and seconds.

    Args:
        setup: statements that run first; their memory is not counted.
        call: the statement to measure.
    """
    path = [str(Path(__file__).parent), *sys.path]
    code = PEAK.format(path=path, threads=torch.get_num_threads(), setup=setup, call=call)
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, env=os.environ
    )
    seconds, peak = done.stdout.split()[-2:]
    return int(peak), float(seconds)


def machine() -> dict[str, Any]:
    """Return a record's description of the machine and the software."""
    from mops_lightning.records.run_record import environment

    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        name = lines[0].split(":")[1].strip() if lines else name
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {**environment(), "cpu": name, "cores": os.cpu_count(), "gpu": gpu}
