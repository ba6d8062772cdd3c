"""The table and the page of a comparison."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mops_lightning.files.compare import FileResult
from mops_lightning.filesystem import atomic_write
from mops_lightning.report.page import render
from mops_lightning.report.text import Grid, markdown
from mops_lightning.viz.snapshots import INPUT, MAX_INPUT_POINTS

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
