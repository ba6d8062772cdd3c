"""``python benchmarks/frame_memory.py FRAME --m 1000``: time and memory of sampling one frame.

Every method of ``compare --task icp`` samples the frame in a process of its own, on Linux. The
memory is the peak during the sampling above what the process held before.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from mops_lightning.files.icp.methods import NAMES, methods_of
from mops_lightning.files.icp.pairs import read_points

FEW = 2_000
"""Points of a first sample, which loads the libraries and the compiled loops."""


def memory(name: str) -> int:
    """Return a number of kilobytes from the process's status, such as VmHWM, the peak."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1])
    raise LookupError(name)


def measure(frame: Path, m: int, name: str) -> str:
    """Return a row of the table, in this process."""
    points = read_points(frame, 0, None, 10_000)
    (method,) = methods_of([name], None, None, [m])
    method.sample(points[:FEW], min(m, FEW), 0, frame)
    before = memory("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins again
    sample = method.sample(points, m, 0, frame)
    peak = memory("VmHWM") - before
    return f"| {name} | {len(sample.points):,} | {sample.seconds:.3f} | {peak / 1024:.0f} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("frame", type=Path)
    parser.add_argument("--m", type=int, default=1000)
    parser.add_argument("--only", choices=NAMES, help="this method, in this process")
    chosen = parser.parse_args()
    if chosen.only:
        print(measure(chosen.frame, chosen.m, chosen.only))
        return
    print("| method | points | seconds | MB |\n|---|--:|--:|--:|", flush=True)
    for name in NAMES:
        one = [sys.executable, __file__, str(chosen.frame), "--m", str(chosen.m), "--only", name]
        subprocess.run(one, check=True)


if __name__ == "__main__":
    main()
