"""``python benchmarks/calls.py``: the calls that users make, beside the loop and other libraries.

Processor time of one thread; the calls of a row take turns. *Loop* is the compiled loop alone, from
a given first point. Clouds are unit spheres, in float32 for farthest points. Libraries that are not
installed are left out: fpsample, torch-quickfps, point-cloud-utils, small_gicp, open3d-cpu. The
table goes into benchmarks/README.md, too. Set OMP_NUM_THREADS=1.
"""

import argparse
import json
import time
from collections.abc import Iterator
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import measure
import numpy as np
import torch
from budgets import sphere, voxel_cases
from cases import cloud
from libraries import Calls, installed
from torch import Tensor

from mops_lightning import downsample, fps
from mops_lightning.ops.farthest import farthest_rows

FARTHEST = (
    (1, 1024, 32),
    (1, 1024, 512),
    (1, 10_000, 1024),
    (1, 40_960, 4096),
    (1, 100_000, 1024),
    (32, 1024, 32),
    (32, 1024, 512),
    (1, 1_000_000, 1000),
)
"""Numbers of clouds, of points, and of points to keep."""

OTHERS = (
    ("random", 100_000, 1000),
    ("serial", 100_000, 1000),
    ("poisson", 100_000, 1000),
    ("poisson", 100_000, 10_000),
)
"""Methods, numbers of points, and of points to keep."""

VOXELS = ((10_000, 0.1, 1000), (100_000, 0.1, 1000))
"""Numbers of points, sizes of voxels, and numbers of points of the form with exactly m."""

HEIGHTS = (3, 5, 7)
"""Heights of the trees of the libraries; the fastest one counts."""

LIBRARIES = (
    "fpsample",
    "torch-quickfps",
    "point-cloud-utils",
    "small_gicp",
    "open3d-cpu",
    "numba",
)

LEFT_OUT = {"torch-fps": "its first call compiles for more than five minutes"}
"""Libraries that are never timed, and why."""

README = Path(__file__).with_name("README.md")

BEGIN, END = "<!-- calls: begin -->", "<!-- calls: end -->"
"""Lines of the README around the table."""


def farthest_calls(points: Tensor, m: int) -> Calls:
    """Return the calls that choose m farthest points of clouds ``(B, N, 3)``."""
    clouds, number, _ = points.shape
    array = points.numpy()
    given, counts = np.zeros((clouds, 1), np.int64), np.ones(clouds, np.int64)
    flat, batch = points.flatten(0, 1), torch.arange(clouds).repeat_interleave(number)
    form = points[0] if clouds == 1 else points
    calls: Calls = {
        "loop": partial(farthest_rows, array, given, counts, m),
        "downsample": partial(downsample, form, m),
        "downsample, array": partial(downsample, form.numpy(), m),
        "fps": partial(fps, flat, batch if clouds > 1 else None, (m - 0.5) / number),
    }
    if fpsample := installed("fpsample"):
        for height in HEIGHTS:
            choose = partial(_each, fpsample.bucket_fps_kdline_sampling, array, m, height)
            calls[f"fpsample, height {height}"] = choose
    if quick := installed("torch_quickfps"):
        for height in HEIGHTS:
            calls[f"torch-quickfps, height {height}"] = partial(quick.sample, points, m, height)
    return calls


def _each(choose: Any, clouds: Any, m: int, height: int) -> list[Any]:
    return [cloud[choose(cloud, m, height)] for cloud in clouds]


def other_calls(method: str, number: int, m: int) -> Calls:
    """Return the calls that choose m points by another method."""
    points = cloud(number)[0]
    calls: Calls = {"downsample": partial(downsample, points, m, method)}
    if method == "poisson" and (utils := installed("point_cloud_utils")):
        reduce = utils.downsample_point_cloud_poisson_disk
        array = points.numpy().astype(np.float64)
        calls["point-cloud-utils"] = partial(reduce, array, -1, target_num_samples=m, random_seed=1)
    return calls


def timed(names: dict[str, Any], calls: Calls, rounds: int) -> list[dict[str, Any]]:
    """Time the calls in turn; of a library with several heights the fastest one is kept."""
    rows: dict[str, dict[str, Any]] = {}
    for name, timing in measure.interleaved(calls, rounds).items():
        call = name.partition(", height")[0]
        if call not in rows or timing.median < rows[call]["seconds"]:
            spread = timing.high - timing.low
            row = {"call": call, "seconds": timing.median, "spread": spread, "rounds": rounds}
            rows[call] = names | row
    return list(rows.values())


def table(record: dict[str, Any]) -> str:
    """Return the medians in milliseconds, one line for what is sampled, one column for a call."""
    seconds: dict[tuple[str, str], dict[str, float]] = {}
    for row in record["cases"]:
        several = f"{row['clouds']} x " if row["clouds"] > 1 else ""
        case = (row["method"], f"{several}{row['N']:,} → {row['m']:,}")
        seconds.setdefault(case, {})[row["call"]] = row["seconds"]
    calls = list(dict.fromkeys(row["call"] for row in record["cases"]))
    lines = [
        f"| method | points | {' | '.join(calls)} |",
        f"|---|---|{'--:|' * len(calls)}",
    ]
    for (method, points), found in seconds.items():
        cells = [_milliseconds(found[call]) if call in found else "" for call in calls]
        lines.append(f"| {method} | {points} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:,.0f}" if seconds >= 1 else f"{1e3 * seconds:.3g}"


def page(record: dict[str, Any]) -> str:
    """Return the table, and how it was measured."""
    git = record["machine"]["git"]
    changes = " with changes" if git["dirty"] else ""
    versions = ", ".join(f"{name} {number}" for name, number in record["others"].items())
    left_out = "; ".join(f"{name} is left out: {why}" for name, why in record["left_out"].items())
    spread = max(row["spread"] / row["seconds"] for row in record["cases"])
    numbers = sorted({row["rounds"] for row in record["cases"]})
    rounds = " or ".join(str(number) for number in numbers)
    return (
        "# Calls\n\n"
        f"Milliseconds. {record['machine']['cpu']}, one thread, processor time on a busy machine, "
        f"medians of {rounds} rounds; the distance between the quartiles is at most "
        f"{spread:.0%} of the median. Commit {git['commit'][:10]}{changes}; {versions}. "
        f"{left_out}. `python benchmarks/calls.py`\n\n" + table(record)
    )


def readme_with(text: str, record: dict[str, Any]) -> str:
    """Return the text of the README with the table of a record."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{table(record)}\n{END}{after}"


def _versions() -> dict[str, str]:
    """Return the versions of the installed libraries."""
    versions = {}
    for name in LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def main() -> None:
    """Measure, and write the record and the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/cpu_calls"))
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    measure.clock = time.process_time
    record: dict[str, Any] = {
        "machine": measure.machine(),
        "others": _versions(),
        "left_out": LEFT_OUT,
        "rounds": chosen.rounds,
        "cases": [],
    }
    for names, calls in _rows():
        record["cases"] += timed(names, calls, chosen.rounds)
        chosen.out.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n")
        chosen.out.with_suffix(".md").write_text(page(record))
    README.write_text(readme_with(README.read_text(), record))
    print(page(record))


def _rows() -> Iterator[tuple[dict[str, Any], Calls]]:
    """Yield what each row measures, and its calls; the rows that take longest come last."""
    for clouds, number, m in FARTHEST:
        names = {"method": "fps", "clouds": clouds, "N": number, "m": m}
        yield names, farthest_calls(cloud(number, clouds), m)
    for method, number, m in OTHERS:
        names = {"method": method, "clouds": 1, "N": number, "m": m}
        yield names, other_calls(method, number, m)
    for number, size, m in VOXELS:
        names = {"method": "voxel", "clouds": 1, "N": number, "m": m, "size": size}
        yield names, voxel_cases(sphere(number), size, m)


if __name__ == "__main__":
    main()
