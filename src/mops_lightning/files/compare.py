"""Comparing methods of downsampling on a file: how well a sample covers the cloud, and its time.

The result is a table and a page with the clouds in 3-D.
"""

import csv
import io
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mops_lightning.data.formats.guard import check_size
from mops_lightning.data.formats.registry import read
from mops_lightning.errors import UserError
from mops_lightning.files.downsample import SURFACE, load_sampler, sample_cloud
from mops_lightning.files.options import Options
from mops_lightning.filesystem import atomic_write
from mops_lightning.report.page import render
from mops_lightning.report.text import Grid, markdown
from mops_lightning.viz.snapshots import INPUT, MAX_INPUT_POINTS
from mops_lightning.zoo.names import UNTRAINED

Points = NDArray[np.float64]
Rows = NDArray[np.int64]

TRAINED = "trained"

FILES = ("table.csv", "compare.html")
"""The files of a comparison."""

COLUMNS = {"chamfer": ".4g", "hausdorff": ".4g", "density": ".2f", "seconds": ".2f"}
"""The measures, and their formats."""

MEANINGS = [
    "All values are better when lower. Distances are in the file's own unit, and not squared.",
    "- chamfer: mean distance from an input point to the nearest kept point. hausdorff: the "
    "largest one.",
    "- density: standard deviation over mean of the number of input points per kept point. At 0 "
    "the sample has the density of the input; even sampling of an uneven scan has a high value.",
    "- seconds: time of the sampling alone, on this machine.",
]


@dataclass(frozen=True)
class Result:
    """One method on one file. Distances are in the file's own unit, and not squared.

    Attributes:
        method: its name.
        rows: ``(m,)`` rows of the kept points.
        chamfer: mean distance from an input point to the nearest kept point. All kept points are
            input points, so that the other direction of the chamfer distance is 0.
        hausdorff: the largest of these distances.
        density: standard deviation over mean of the number of input points that a kept point is
            nearest to; 0 if the sample is as dense as the input everywhere.
        seconds: time of the sampling alone.
    """

    method: str
    rows: Rows
    chamfer: float
    hausdorff: float
    density: float
    seconds: float


@dataclass(frozen=True)
class FileResult:
    """All methods on one file.

    Attributes:
        path: the file.
        points: ``(N, 3)`` its points with finite coordinates.
        m: number of points to keep.
        results: one for every method.
    """

    path: Path
    points: Points
    m: int
    results: list[Result]


def options_by_method(
    m: int, names: Sequence[str], weights: str | None, tile: int | None, seed: int
) -> dict[str, Options]:
    """Return the options of every method.

    Args:
        m: number of points to keep.
        names: untrained methods.
        weights: of a trained sampler, or None.
        tile: see ``Options``; for the trained sampler.
        seed: of random choices.

    Raises:
        UserError: a value is out of range.
    """
    options = {name: Options(m, method=name, seed=seed) for name in UNTRAINED if name in names}
    if weights is not None:
        options[TRAINED] = Options(m, weights, seed=seed, tile=tile)
    return options


def compare_file(path: Path, m: int, methods: dict[str, Options], seed: int) -> FileResult:
    """Sample a file by all methods and measure the samples.

    Args:
        path: the file.
        m: number of points to keep.
        methods: from ``options_by_method``, for the same ``m``.
        seed: of a mesh's points.

    Raises:
        UserError: the file holds no usable cloud, or too few points.
    """
    points = read(path, max(SURFACE, 8 * m), seed).finite().points
    check_size(path, len(points), m)
    results = []
    for name, options in methods.items():
        _warm_up(path, points, m, options)
        start = time.perf_counter()
        rows = _sample(path, points, m, options)
        seconds = time.perf_counter() - start
        results.append(Result(name, rows, *coverage(points, points[rows]), seconds))
    return FileResult(path, points, m, results)


def coverage(points: Points, kept: Points) -> tuple[float, float, float]:
    """Return the chamfer distance, the Hausdorff distance and the density; see ``Result``.

    Args:
        points: ``(N, 3)`` the input.
        kept: ``(m, 3)`` some of its points.
    """
    neighbours: Any = cKDTree(kept).query(points)
    distance, nearest = neighbours
    members = np.bincount(nearest, minlength=len(kept))
    return float(distance.mean()), float(distance.max()), float(members.std() / members.mean())


def _warm_up(path: Path, points: Points, m: int, options: Options) -> None:
    """Sample a few points, so that imports and compilation are in no method's time."""
    few = np.random.default_rng(0).permutation(len(points))[: 2 * m]
    # A part may be unusable where the whole is not, such as one of equal points.
    with suppress(UserError):
        _sample(path, points[few], m, options)


def _sample(path: Path, points: Points, m: int, options: Options) -> Rows:
    rows, _ = sample_cloud(points, load_sampler(options), m, options, path)
    assert rows is not None  # completed sets are rows
    return rows


def write_comparison(results: Sequence[FileResult], folder: Path) -> str:
    """Write the table and the page, and return the table as text."""
    grids = [_grid(result) for result in results]
    clouds = [_clouds(result) for result in results]
    page = render("compare", grids, clouds, MEANINGS, "How to read this", choice="File")
    for name, content in zip(FILES, (_csv(results), page), strict=True):
        with atomic_write(folder / name) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return markdown(grids, MEANINGS)


def _grid(compared: FileResult) -> Grid:
    title = f"{compared.path.name}: {compared.m:,} of {len(compared.points):,} points"
    rows = [
        [result.method, *(format(getattr(result, name), form) for name, form in COLUMNS.items())]
        for result in compared.results
    ]
    return Grid(title, ["method", *COLUMNS], rows)


def _csv(results: Sequence[FileResult]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["file", "points", "m", "method", *COLUMNS])
    for compared in results:
        for result in compared.results:
            values = [repr(getattr(result, name)) for name in COLUMNS]
            number = len(compared.points)
            writer.writerow([compared.path, number, compared.m, result.method, *values])
    return out.getvalue()


def _clouds(compared: FileResult) -> dict[str, Any]:
    """Return a file's clouds for the page, in the unit sphere."""
    points = compared.points
    centred = points - points.mean(0)
    turned = centred[:, [0, 2, 1]] * [1, 1, -1] / (np.abs(centred).max() or 1.0)  # z up to y up
    step = -(-len(points) // MAX_INPUT_POINTS)
    sets = {INPUT: turned[::step], **{r.method: turned[r.rows] for r in compared.results}}
    shown = (INPUT, compared.results[-1].method)  # the trained sampler, if there is one
    return {
        "name": f"{compared.path.name}, {compared.m:,} points",
        "titles": [compared.path.stem],
        "points": {name: [cloud.round(3).tolist()] for name, cloud in sets.items()},
        "colours": {INPUT: "lightgrey"},  # the page chooses the others
        "hidden": [name for name in sets if name not in shown],
    }
