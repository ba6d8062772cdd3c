"""How times and memory are taken: the method of every figure under benchmarks/."""

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
"""Calls before any is timed: caches, thread pools and allocators settle."""

LEAST = 0.05
"""Seconds that one timing takes at least; quicker calls are repeated within it."""


class Timing(NamedTuple):
    """Seconds of one call, over rounds.

    Attributes:
        median: of all rounds.
        low: first quartile.
        high: third quartile.
        rounds: how many.
    """

    median: float
    low: float
    high: float
    rounds: int


def interleaved(cases: Mapping[str, Callable[[], Any]], rounds: int = 7) -> dict[str, Timing]:
    """Time several calls in turns, so that a slow spell of the machine meets all of them.

    Args:
        cases: what to call, by name.
        rounds: how often each is timed.

    Returns:
        By name, the median and quartiles of the seconds of one call.
    """
    repeats = {}
    for name, call in cases.items():
        last = LEAST
        for _ in range(WARM_UP):
            start = time.perf_counter()
            _wait(call())
            last = time.perf_counter() - start
        repeats[name] = max(1, round(LEAST / max(last, 1e-9)))
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds):
        for name, call in cases.items():
            gc.collect()
            start = time.perf_counter()
            for _ in range(repeats[name]):
                result = call()
            _wait(result)
            seconds[name].append((time.perf_counter() - start) / repeats[name])
    return {name: _timing(values) for name, values in seconds.items()}


def _timing(values: list[float]) -> Timing:
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
    """Measure what the machine can do: matrix products, and copies that miss the caches.

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
Path("/proc/self/clear_refs").write_text("5")  # getrusage knows the peak of the parent, too
before = status("VmRSS")
start = time.perf_counter()
{call}
print(time.perf_counter() - start)
print(status("VmHWM") - before)
"""


def peak_memory(setup: str, call: str) -> tuple[int, float]:
    """Return the bytes by which a statement raises the peak of a process of its own, and seconds.

    Args:
        setup: statements before; what they hold is not counted.
        call: the statement.
    """
    path = [str(Path(__file__).parent), *sys.path]
    code = PEAK.format(path=path, threads=torch.get_num_threads(), setup=setup, call=call)
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, env=os.environ
    )
    seconds, peak = done.stdout.split()[-2:]
    return int(peak), float(seconds)


def machine() -> dict[str, Any]:
    """Return what a record must say about where it was taken."""
    from mops_lightning.records.environment import environment

    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        name = lines[0].split(":")[1].strip() if lines else name
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {**environment(), "cpu": name, "cores": os.cpu_count(), "gpu": gpu}
