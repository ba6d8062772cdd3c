"""``python benchmarks/threads.py``: seconds of an epoch of the main job beside busy processes.

The table of docs/runs.md, "Threads". The task net is trained once before; rounds take turns.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from mops_lightning.records import run_record

JOB = (sys.executable, "-m", "mops_lightning", "epochs.sampler=1", "logger=none", "pictures=0")
BUSY = (sys.executable, "-c", "while True: pass")
WAYS = {
    "1 thread": {"OMP_NUM_THREADS": "1"},
    "2 threads, 300,000 times": {"OMP_NUM_THREADS": "2", "GOMP_SPINCOUNT": "300000"},
    "2 threads, 1,000 times": {"OMP_NUM_THREADS": "2", "GOMP_SPINCOUNT": "1000"},
    "2 threads, passive": {"OMP_NUM_THREADS": "2", "OMP_WAIT_POLICY": "PASSIVE"},
}
"""Environment variables by head of a column."""


def epoch(variables: dict[str, str], settings: list[str]) -> float:
    """Return the seconds of the training of one run with these environment variables."""
    with tempfile.TemporaryDirectory() as folder:
        command = [*JOB, *settings, f"hydra.run.dir={folder}/run"]
        environment = {**os.environ, **variables}
        subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
        return run_record.read(Path(folder) / "run").seconds["fit"]


def main() -> None:
    """Measure every way beside every number of busy processes, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--rounds", type=int, default=2)
    chosen, settings = parser.parse_known_args()
    epoch({}, settings)
    print(f"| busy processes | {' | '.join(WAYS)} |\n|{'--:|' * (len(WAYS) + 1)}")
    for number in chosen.busy:
        others = [subprocess.Popen(BUSY) for _ in range(number)]
        try:
            rounds = [[epoch(way, settings) for way in WAYS.values()] for _ in range(chosen.rounds)]
        finally:
            for other in others:
                other.kill()
        cells = [
            ", ".join(f"{value:.1f}" for value in times) for times in zip(*rounds, strict=True)
        ]
        print(f"| {number} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
