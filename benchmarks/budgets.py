"""``python benchmarks/budgets.py``: voxels and spacings beside other libraries, on a sphere.

Processor time of one thread; every case takes turns with the others. Libraries that are not
installed are left out: point-cloud-utils, small_gicp, open3d-cpu. Set OMP_NUM_THREADS=1.
"""

import argparse
import json
import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import libraries
import measure
import numpy as np
import torch
from numpy.typing import NDArray

from mops_lightning import downsample

Points = NDArray[np.float64]
Call = Callable[[], Any]

VOXELS = ((10_000, 0.1, 1_000), (100_000, 0.1, 1_000), (1_000_000, 0.02, None))
"""Numbers of points, sizes of voxels, and numbers of points of the form with exactly m."""

SPACINGS = ((100_000, 0.1), (1_000_000, 0.02))


def sphere(number: int) -> Points:
    """Return points on the unit sphere, in random order."""
    points = np.random.default_rng(0).normal(size=(number, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def voxel_cases(points: Points, size: float, m: int | None) -> dict[str, Call]:
    """Return the calls that keep one point per voxel."""
    cases: dict[str, Call] = {"downsample(voxel=)": lambda: downsample(points, voxel=size)}
    if m is not None:
        cases["downsample(m, 'voxel')"] = lambda: downsample(points, m, "voxel")
    if find_spec("point_cloud_utils"):
        point_cloud_utils = import_module("point_cloud_utils")
        reduce = point_cloud_utils.downsample_point_cloud_on_voxel_grid
        cases["point-cloud-utils"] = lambda: reduce(size, points)
    if find_spec("small_gicp"):
        small_gicp = import_module("small_gicp")
        cases["small_gicp"] = lambda: small_gicp.voxelgrid_sampling(points, size)
    if find_spec("open3d"):
        open3d = import_module("open3d")
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        cases["open3d"] = lambda: cloud.voxel_down_sample(size)
    return cases


def spacing_cases(points: Points, spacing: float) -> dict[str, Call]:
    """Return the calls that keep points of a smallest distance."""
    cases: dict[str, Call] = {"downsample(spacing=)": lambda: downsample(points, spacing=spacing)}
    if find_spec("point_cloud_utils"):
        point_cloud_utils = import_module("point_cloud_utils")
        reduce = point_cloud_utils.downsample_point_cloud_poisson_disk
        cases["point-cloud-utils"] = lambda: reduce(points, spacing, random_seed=1)
    return cases


def rows(kind: str, number: int, distance: float, cases: dict[str, Call], rounds: int) -> list[Any]:
    """Time the cases in turn."""
    timings = measure.interleaved(cases, rounds)
    return [
        {
            "kind": kind,
            "function": name,
            "N": number,
            "distance": distance,
            "seconds": timing.median,
            "spread": timing.high - timing.low,
            "rounds": timing.rounds,
        }
        for name, timing in timings.items()
    ]


def page(results: list[Any], versions: dict[str, str]) -> str:
    """Return the results as a table."""
    libraries_used = ", ".join(f"{name} {version}" for name, version in versions.items())
    lines = [
        "# Voxels and spacings",
        "",
        "Points on a unit sphere in random order. Processor time of one thread on a busy machine; "
        "medians; spread: distance between the quartiles. Libraries: "
        f"{libraries_used}. `python benchmarks/budgets.py`",
        "",
        "| budget | function | N | distance | ms | spread |",
        "|---|---|--:|--:|--:|--:|",
    ]
    for row in results:
        ms, spread = 1e3 * row["seconds"], 1e3 * row["spread"]
        lines.append(
            f"| {row['kind']} | {row['function']} | {row['N']:,} | {row['distance']:g} | "
            f"{ms:.3g} | {spread:.2g} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, and write the record and the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/cpu_budgets"))
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    measure.clock = time.process_time
    results = []
    for number, size, m in VOXELS:
        cases = voxel_cases(sphere(number), size, m)
        results += rows("voxel", number, size, cases, chosen.rounds)
    for number, spacing in SPACINGS:
        cases = spacing_cases(sphere(number), spacing)
        results += rows("spacing", number, spacing, cases, chosen.rounds)
    versions = libraries.versions()
    record = {"machine": measure.machine(), "libraries": versions, "cases": results}
    chosen.out.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n")
    text = page(results, versions)
    chosen.out.with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
