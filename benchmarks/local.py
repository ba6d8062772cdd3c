"""Benchmark of local columns of S against full columns and farthest points."""

import json
import statistics
import subprocess
import sys
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from cases import Row, cloud, frozen, seconds, step
from libraries import Calls
from measure import interleaved
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose
from mops_lightning.ops.fps import farthest_point_sample
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.zoo import weights

KINDS = ((4, 64), (4, 16), (2, 16))
"""Candidates per point and entries of a column; the first pair is the tested one."""

FILE_POINTS = 8_000_000
FILE_M = 10_000
COMMAND = """
import json, re, sys, time
from pathlib import Path
from mops_lightning.cli.main import main
try:
    main()
finally:
    peak = re.search("VmHWM:[^0-9]*([0-9]+)", Path("/proc/self/status").read_text())[1]
    print(json.dumps([time.process_time(), int(peak) * 1024]))
"""
"""Runs a command line; its last line has the process's seconds and the peak of its memory."""


def nets(m: int) -> dict[str, MOPSNet]:
    """Return samplers with local columns."""
    return {
        f"local columns, c={c}, k={k}": MOPSNet(m, anchors="fps", candidates=c, neighbours=k)
        for c, k in KINDS
    }


def local(_peak: dict[str, float], rounds: int) -> list[Row]:
    """Local columns, full columns and farthest points; seconds per cloud, untrained nets.

    Clouds are spheres. ``sample`` in evaluation, one cloud; ``learn`` is a training step of the
    sampler alone with 8 clouds. Full columns of 1,000,000 points take too long to be repeated.
    ``file`` is the whole command on a binary PLY file, its start included; memory of its process.
    """
    rows: list[Row] = []
    for number, m in ((1_000_000, 4096), (40_960, 4096)):
        points = cloud(number)
        calls: Calls = {
            "farthest points": partial(farthest_point_sample, points, m),
            "FPSSampler": partial(frozen, FPSSampler(m), points),
        }
        if number < 1_000_000:
            calls["full columns"] = partial(frozen, MOPSNet(m, anchors="fps"), points)
        calls |= {name: partial(frozen, net, points) for name, net in nets(m).items()}
        rows += _timed(calls, {"N": number, "m": m, "step": "sample"}, rounds, 1)
    points = cloud(10_000, 8)
    calls = {"full columns": partial(step, MOPSNet(256, anchors="fps"), points)}
    calls |= {name: partial(step, net, points) for name, net in nets(256).items()}
    rows += _timed(calls, {"N": 10_000, "m": 256, "step": "learn"}, rounds, 8)
    return rows + _of_file(min(rounds, 3))


def _of_file(rounds: int) -> list[Row]:
    """Return a row for the whole command on a PLY file; its memory is that of its process."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        _write_terrain(folder / "terrain.ply")
        candidates, neighbours = KINDS[0]
        settings = ["sampler=mops", "sampler.anchors=fps", f"m={FILE_M}"]
        settings += [f"sampler.candidates={candidates}", f"sampler.neighbours={neighbours}"]
        net = MOPSNet(FILE_M, anchors="fps", candidates=candidates, neighbours=neighbours)
        config: Any = OmegaConf.to_container(compose(settings), resolve=True)
        weights.save(folder / "net.safetensors", net, config, {})
        arguments = ["downsample", "terrain.ply", "few.ply", "--m", str(FILE_M)]
        arguments += ["--weights", "net.safetensors", "--overwrite"]
        runs = []
        for _ in range(rounds):
            done = subprocess.run(
                [sys.executable, "-c", COMMAND, *arguments],
                cwd=folder,
                check=True,
                capture_output=True,
                text=True,
            )
            runs.append(json.loads(done.stdout.splitlines()[-1]))
    seconds_of_runs, peaks = zip(*runs, strict=True)
    return [
        {
            "sampler": f"local columns, c={candidates}, k={neighbours}",
            "N": FILE_POINTS,
            "m": FILE_M,
            "step": "file",
            "seconds": statistics.median(seconds_of_runs),
            "spread": max(seconds_of_runs) - min(seconds_of_runs),
            "peak_bytes": max(peaks),
        }
    ]


def _write_terrain(path: Path) -> None:
    """Write hills of 200 by 200 units as a binary PLY file."""
    rng = np.random.default_rng(0)
    points = 200 * rng.random((FILE_POINTS, 3), dtype=np.float32)
    hills = 3 * np.sin(points[:, 0] / 7) + 4 * np.cos(points[:, 1] / 11)
    points[:, 2] = hills + rng.normal(scale=0.05, size=FILE_POINTS)
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {FILE_POINTS}\n{properties}"
    with path.open("wb") as file:
        file.write(f"{header}end_header\n".encode())
        points.astype("<f4").tofile(file)


def _timed(calls: Calls, names: Row, rounds: int, clouds: int) -> list[Row]:
    timings = interleaved(calls, rounds).items()
    return [{"sampler": name, **names, **seconds(timing, clouds)} for name, timing in timings]
