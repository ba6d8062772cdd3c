"""Comparing methods of downsampling on a file: how well a sample covers the cloud, and its time.

The result is a table and a page with the clouds in 3-D.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError, cKDTree
from torch import Tensor

from mops_lightning.data.formats.guard import check_size
from mops_lightning.data.formats.registry import read
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from mops_lightning.files.arguments import COMPARED
from mops_lightning.files.downsample import SURFACE, load_sampler
from mops_lightning.files.features import channels_for
from mops_lightning.files.normal_columns import normals_of
from mops_lightning.files.options import Options
from mops_lightning.files.sample_cloud import sample_cloud
from mops_lightning.filesystem import atomic_write
from mops_lightning.report.page import render
from mops_lightning.report.text import Grid, markdown
from mops_lightning.samplers.by_normals import ByNormals
from mops_lightning.viz.figures import INPUT, thinned
from mops_lightning.zoo.names import UNTRAINED

Points = NDArray[np.float64]
Rows = NDArray[np.int64]

TRAINED = "trained"

COLUMNS = {
    "chamfer": ".4g",
    "hausdorff": ".4g",
    "density": ".2f",
    "ground": ".4g",
    "seconds": ".2f",
}
"""The measures, and their formats."""

CLASSES = "classification"
GROUND = 2
"""The column with the classes of airborne scans, and the class of the ground (LAS 1.4)."""

MEANINGS = [
    "All values are better when lower. Distances are in the file's own unit, and not squared.",
    "- chamfer: mean distance from an input point to the nearest kept point. hausdorff: the "
    "largest one.",
    "- density: standard deviation over mean of the number of input points per kept point. At 0 "
    "the sample has the density of the input; even sampling of an uneven scan has a high value.",
    "- seconds: time of the sampling alone, on this machine.",
]

MEANING_OF_GROUND = (
    "- ground: root mean square error of the heights of all ground points (class 2 of airborne "
    "scans) on the surface through the kept ground points."
)


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
        ground: see ``ground_error``; None for a file without ground points.
        seconds: time of the sampling alone.
    """

    method: str
    rows: Rows
    chamfer: float
    hausdorff: float
    density: float
    ground: float | None
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
    m: int,
    names: Sequence[str],
    weights: str | None,
    tile: int | None,
    seed: int,
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
    options = {}
    for name in UNTRAINED:
        if name in names:
            options[name] = Options(m, method=name, seed=seed)
    if weights is not None:
        options[TRAINED] = Options(m, weights, seed=seed, tile=tile)
    return options


def compare_file(
    path: Path,
    m: int,
    methods: dict[str, Options],
    seed: int,
    columns: Sequence[str] | None = None,
) -> FileResult:
    """Sample a file by all methods and measure the samples.

    Args:
        path: the file.
        m: number of points to keep.
        methods: from ``options_by_method``, for the same ``m``.
        seed: of a mesh's points.
        columns: names of the columns of a .bin file; None: those that its name implies.

    Raises:
        UserError: the file holds no usable cloud, or too few points.
    """
    surface = max(SURFACE, 8 * m)
    table = read(path, surface, seed, columns=columns).finite()
    points = table.points
    classes = table.columns.get(CLASSES, np.empty(0))
    is_ground = classes == GROUND
    check_size(path, len(points), m)
    results = []
    for name, options in methods.items():
        sampler = load_sampler(options)
        channels = channels_for(table, sampler.point_channels, path)
        _warm_up(path, table, m, options, channels)
        start = time.perf_counter()
        rows = _sample(path, table, m, options, channels)
        seconds = time.perf_counter() - start
        kept = points[rows]
        error = None
        if is_ground.any():
            is_kept_ground = is_ground[rows]
            error = ground_error(points[is_ground], kept[is_kept_ground])
        chamfer, hausdorff, density = coverage(points, kept)
        results.append(Result(name, rows, chamfer, hausdorff, density, error, seconds))
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
    density = members.std() / members.mean()
    return float(distance.mean()), float(distance.max()), float(density)


def ground_error(ground: Points, kept: Points) -> float:
    """Return the root mean square error of heights on a surface through some of the points.

    The surface is linear in the triangles of a Delaunay triangulation in x and y. Outside of them
    it has the height of the nearest kept point.

    Args:
        ground: ``(N, 3)`` all ground points.
        kept: ``(k, 3)`` some of them.

    Returns:
        The error in the file's unit; NaN if no ground point was kept.
    """
    if not len(kept):
        return float("nan")
    middle = ground[:, :2].mean(0)  # float64 has too few digits for products of map coordinates
    places = ground[:, :2] - middle
    known = kept[:, :2] - middle
    _, nearest = cKDTree(known).query(places)
    height = kept[nearest, 2]
    with suppress(QhullError, ValueError):  # fewer than three points, or all on one line
        surface = LinearNDInterpolator(known, kept[:, 2])(places)
        height = np.where(np.isnan(surface), height, surface)
    errors = height - ground[:, 2]
    return float(np.sqrt(np.square(errors).mean()))


def _warm_up(path: Path, table: Table, m: int, options: Options, channels: Tensor | None) -> None:
    """Sample a few points, so that imports and compilation are in no method's time."""
    order = np.random.default_rng(0).permutation(len(table.points))
    few = order[: 2 * m]
    # A part may be unusable where the whole is not, such as one of equal points.
    with suppress(UserError):
        of_few = None
        if channels is not None:
            of_few = channels[torch.from_numpy(few)]
        _sample(path, table.take(few), m, options, of_few)


def _sample(path: Path, table: Table, m: int, options: Options, channels: Tensor | None) -> Rows:
    sampler = load_sampler(options)
    normals = None
    if isinstance(sampler, ByNormals):
        normals = normals_of(table)
    rows, _ = sample_cloud(
        table.points, sampler, m, options, path, channels=channels, normals=normals
    )
    assert rows is not None  # completed sets are rows
    return rows


def write_comparison(results: Sequence[FileResult], folder: Path) -> str:
    """Write the table and the page, and return the table as text."""
    grids = [_grid(result) for result in results]
    clouds = [_clouds(result) for result in results]
    meanings = list(MEANINGS)
    if any("ground" in grid.head for grid in grids):
        meanings.append(MEANING_OF_GROUND)
    page = render("compare", grids, clouds, meanings, "How to read this", choice="File")
    contents = (_csv(results), page)
    for name, content in zip(COMPARED, contents, strict=True):
        with atomic_write(folder / name) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return markdown(grids, meanings)


def _grid(compared: FileResult) -> Grid:
    first = compared.results[0]
    title = f"{compared.path.name}: {compared.m:,} of {len(compared.points):,} points"
    forms = {}
    for name, form in COLUMNS.items():
        if getattr(first, name) is not None:
            forms[name] = form
    rows = []
    for result in compared.results:
        cells = [format(getattr(result, name), form) for name, form in forms.items()]
        rows.append([result.method, *cells])
    return Grid(title, ["method", *forms], rows)


def _csv(results: Sequence[FileResult]) -> str:
    rows = []
    for compared in results:
        for result in compared.results:
            row = {
                "file": compared.path,
                "points": len(compared.points),
                "m": compared.m,
                "method": result.method,
            }
            for name in COLUMNS:
                row[name] = getattr(result, name)
            rows.append(row)
    return pd.DataFrame(rows).to_csv(index=False, lineterminator="\n")


def _clouds(compared: FileResult) -> dict[str, Any]:
    """Return a file's clouds for the page, in the unit sphere."""
    points = compared.points
    centred = points - points.mean(0)
    largest = np.abs(centred).max() or 1.0
    turned = centred[:, [0, 2, 1]] * [1, 1, -1] / largest  # z up to y up
    sets = {INPUT: thinned(turned)}
    for result in compared.results:
        sets[result.method] = turned[result.rows]
    points_of_sets = {name: [cloud.round(3).tolist()] for name, cloud in sets.items()}
    shown = (INPUT, compared.results[-1].method)  # the trained sampler, if there is one
    return {
        "name": f"{compared.path.name}, {compared.m:,} points",
        "titles": [compared.path.stem],
        "points": points_of_sets,
        "colours": {INPUT: "lightgrey"},  # the page chooses the others
        "hidden": [name for name in sets if name not in shown],
    }
