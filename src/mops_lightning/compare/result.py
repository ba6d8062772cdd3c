"""The table and the page of a comparison."""

import csv
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mops_lightning.compare.measures import lowest
from mops_lightning.compare.methods import FILES, TRAINED
from mops_lightning.compare.run import FileResult, Result, compare_file
from mops_lightning.downsample_files.settings import Settings
from mops_lightning.filesystem import atomic_write
from mops_lightning.report.page import render
from mops_lightning.report.text import Grid, markdown
from mops_lightning.viz.clouds import COLOURS, INPUT_COLOUR
from mops_lightning.viz.snapshots import INPUT, MAX_INPUT_POINTS

SHOWN = {"random": (148, 103, 189), "voxel": (140, 86, 75), "poisson": (23, 160, 170)}
"""Colours of methods, RGB; those of other methods are in ``viz.clouds``."""


class Column(NamedTuple):
    """A column of the table."""

    title: str
    form: str


HEAD = {
    "chamfer": Column("chamfer", ".4g"),
    "hausdorff": Column("Hausdorff", ".4g"),
    "thin": Column("thin parts", ".4g"),
    "density": Column("density", ".2f"),
    "normals": Column("normals, °", ".1f"),
    "intensity": Column("intensity", ".3f"),
    "colour": Column("colour", ".3f"),
    "seconds": Column("time, s", ".2f"),
    "megabytes": Column("memory, MB", ".0f"),
}
QUALITY = tuple(HEAD)[:-2]
"""What the closing lines count wins of."""

MEANINGS = [
    "All values are better when lower. Distances are in the file's own unit, and not squared.",
    "- chamfer: mean distance from an input point to the nearest kept point. Hausdorff: the "
    "largest one.",
    "- thin parts: the mean distance from input points on poles, wires, limbs and the like, at the "
    "scale of the sample.",
    "- density: standard deviation over mean of the number of input points per kept point. At 0 "
    "the sample has the density of the input; even sampling of an uneven scan has a high value.",
    "- normals: mean angle to the normal of the nearest kept point. intensity, colour: mean "
    "difference from the nearest kept point, in standard deviations of the attribute.",
    "- time, memory: of the sampling alone, on this machine; memory is the growth of the process.",
]


def compared(
    files: Sequence[Path], sizes: dict[int, dict[str, Settings]], seed: int
) -> list[tuple[int, FileResult]]:
    """Compare the methods on every file at every size.

    Raises:
        UserError: a file holds no usable cloud.
    """
    return [(m, compare_file(path, sizes[m], seed)) for path in files for m in sizes]


def write(found: list[tuple[int, FileResult]], folder: Path) -> str:
    """Write the table and the page, and return the table as text."""
    grids = [_grid(m, result) for m, result in found]
    remarks = [*verdict([result for _, result in found]), *MEANINGS]
    text = markdown(grids, remarks)
    clouds = [_clouds(m, result) for m, result in found]
    page = render("compare", grids, clouds, remarks, "How to read this", choice="File")
    for name, content in zip(FILES, (text, _csv(found), page), strict=True):
        with atomic_write(folder / name) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return text


def values(result: Result) -> dict[str, float | None]:
    """Return the values of a result by column."""
    measures = result.measures
    return {
        "chamfer": measures.chamfer,
        "hausdorff": measures.hausdorff,
        "thin": measures.thin,
        "density": measures.density,
        "normals": measures.normals,
        "intensity": measures.attributes.get("intensity"),
        "colour": measures.attributes.get("colour"),
        "seconds": result.seconds,
        "megabytes": result.megabytes,
    }


def verdict(found: Sequence[FileResult]) -> list[str]:
    """Say how often each method is the best, and by what the trained sampler never is."""
    wins: dict[str, Counter[str]] = {}
    for one in found:
        rows = [values(result) for result in one.results]
        for name in QUALITY:
            place = lowest([row[name] for row in rows])
            if place is not None:
                wins.setdefault(name, Counter())[one.results[place].method] += 1
    lines = []
    if any(result.method == TRAINED for one in found for result in one.results):
        lost = [_short(name) for name, count in wins.items() if not count[TRAINED]]
        if len(lost) == len(wins):
            lines.append("The trained sampler is not the best here by any of these measures.")
        elif lost:
            lines.append(f"The trained sampler is never the best by {', '.join(lost)}.")
    for name, count in wins.items():
        ranking = ", ".join(f"{method} {number}" for method, number in count.most_common())
        lines.append(f"- Best by {_short(name)} in {count.total()} comparisons: {ranking}.")
    return [*lines, ""]


def _short(name: str) -> str:
    return HEAD[name].title.partition(",")[0]


def _grid(m: int, one: FileResult) -> Grid:
    rows = [values(result) for result in one.results]
    names = [name for name in HEAD if any(row[name] is not None for row in rows)]
    cells = [
        [
            "n/a" if (value := row[name]) is None else format(value, HEAD[name].form)
            for name in names
        ]
        for row in rows
    ]
    title = (
        f"{one.path.name}: {m:,} of {len(one.table.points):,} points; {one.thin:,} of the evaluated"
        f" points are on parts thinner than the spacing, {one.spacing:.4g}"
    )
    methods = [result.method for result in one.results]
    body = [[method, *row] for method, row in zip(methods, cells, strict=True)]
    return Grid(title, ["method", *(HEAD[name].title for name in names)], body)


def _csv(found: list[tuple[int, FileResult]]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["file", "points", "m", "method", "measure", "value"])
    for m, one in found:
        for result in one.results:
            for name, value in values(result).items():
                if value is not None:
                    row = [one.path, len(one.table.points), m, result.method, name, repr(value)]
                    writer.writerow(row)
    return out.getvalue()


def _clouds(m: int, one: FileResult) -> dict[str, Any]:
    """Return a file's clouds for the page, in the unit sphere."""
    points = one.table.points
    centred = points - points.mean(0)
    turned = centred[:, [0, 2, 1]] * [1, 1, -1] / (np.abs(centred).max() or 1.0)  # z up to y up
    step = -(-len(points) // MAX_INPUT_POINTS)
    sets = {INPUT: turned[::step], **{r.method: turned[r.rows] for r in one.results}}
    colours = {**COLOURS, **SHOWN, INPUT: INPUT_COLOUR, TRAINED: COLOURS["generated"]}
    first = one.results[-1].method  # the trained sampler, if there is one
    return {
        "name": f"{one.path.name}, {m:,} points",
        "titles": [one.path.stem],
        "points": {name: [cloud.round(3).tolist()] for name, cloud in sets.items()},
        "colours": {name: f"rgb{colours.get(name, COLOURS['sampled'])}" for name in sets},
        "hidden": [name for name in sets if name not in (INPUT, first)],
    }
