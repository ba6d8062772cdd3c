"""Curves and heat maps of a report's tables."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from mops_lightning.records.readout_names import GENERATED_READOUTS, INDEX_READOUT
from mops_lightning.report.axes import Axes, row, value
from mops_lightning.report.build import Report, plane
from mops_lightning.report.cells import Cells, place
from mops_lightning.viz.clouds import draw_cloud, upright
from mops_lightning.viz.snapshots import INPUT, load_clouds

WIDE = 20
"""A heat map whose largest figure is so many times its smallest has logarithmic colours."""


def plots(report: Report) -> dict[str, Figure]:
    """Return the figures of all tables by the name of their file, without its suffix."""
    figures = {}
    for table in report.tables:
        if report.axes.planes:
            figures[f"{table.metric.name}_planes"] = heat_maps(table, report.axes)
        elif len(table.columns()) > 1:
            figures[f"{table.metric.name}_curves"] = curves(table, report.axes)
    if report.axes.column != "m" and (figure := clouds_by_column(report)):
        figures["clouds"] = figure
    return figures


def clouds_by_column(report: Report) -> Figure | None:
    """Draw one test cloud as every sampler saw it at every value of the setting, such as noise."""
    found: dict[str, dict[Any, Path]] = {}
    for record in report.scored:
        path = Path(record["folder"]) / record["files"].get("clouds", "")
        if path.is_file():
            name = row(record, report.names["net"])
            found.setdefault(name, {}).setdefault(value(record, report.axes.column), path)
    columns = sorted({column for paths in found.values() for column in paths})
    if not columns:
        return None
    figure = Figure(figsize=(2.6 * len(columns), 2.6 * len(found)), layout="tight")
    FigureCanvasAgg(figure)
    for i, name in enumerate(sorted(found, key=place)):
        for j, column in enumerate(columns):
            if column not in found[name]:
                continue
            _, arrays = load_clouds(found[name][column])
            cloud = upright(arrays.pop(INPUT)[0])
            readout, samples = next(iter(arrays.items()))
            axes = figure.add_subplot(
                len(found), len(columns), i * len(columns) + j + 1, projection="3d"
            )
            draw_cloud(axes, cloud, upright(samples[0]), readout)
            if i == 0:
                axes.set_title(f"{report.axes.column}={column:g}", fontsize=11)
            axes.text2D(0.02, 0.04, f"{name}, {readout}", transform=axes.transAxes, fontsize=9)
    return figure


def curves(table: Cells, axes: Axes) -> Figure:
    """Draw a metric against the size or another setting, one panel for each readout.

    Samplers that choose input points are dashed and the same in all panels. Bars are standard
    deviations over seeds.
    """
    figure = Figure(figsize=(4.2 * len(GENERATED_READOUTS), 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(GENERATED_READOUTS), sharey=True)
    columns = table.columns()[::-1]
    scale = table.metric.scale
    for axis, readout in zip(panels, GENERATED_READOUTS, strict=True):
        for number, name in enumerate(table.rows()):
            cells = table.figures[name]
            chosen = [
                INDEX_READOUT if INDEX_READOUT in cell else readout for cell in cells.values()
            ]
            xs = [column for column in columns if cells.get(column, {}).get(chosen[0])]
            values = [np.array(list(cells[x][chosen[0]].values())) * scale for x in xs]
            if not xs:
                continue
            axis.errorbar(
                [columns.index(x) for x in xs],
                [one.mean() for one in values],
                yerr=[one.std(ddof=1) if len(one) > 1 else 0.0 for one in values],
                label=name,
                color=f"C{number % 10}",
                linestyle="--" if chosen[0] == INDEX_READOUT else "-",
                marker="o",
                markersize=3,
                capsize=2,
            )
        axis.set_title(readout)
        axis.set_xlabel(axes.column)
        axis.set_xticks(range(len(columns)), [f"{column:g}" for column in columns])
        axis.grid(alpha=0.3)
    panels[0].set_ylabel(table.metric.title)
    panels[-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _shades(low: float, high: float) -> Normalize:
    """Return the shared scale of colours: of logarithms where one end would hide all else."""
    wide = low > 0 and high > WIDE * low
    return LogNorm(low, high) if wide else Normalize(low, high)


def heat_maps(table: Cells, axes: Axes) -> Figure:
    """Draw the planes of all samplers, one row each, a column for each readout, in one scale."""
    assert axes.planes is not None
    names = sorted(axes.planes, key=place)
    found = {name: plane(table, name) for name in names}
    everything = [one for by in found.values() for values in by.values() for one in values.values()]
    scale = table.metric.scale
    low, high = scale * min(everything), scale * max(everything)
    shades = _shades(low, high)
    width = max(len(by) for by in found.values())
    figure = Figure(figsize=(3.6 * width + 1, 3.2 * len(names)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(names), width, squeeze=False)
    for line, name in zip(panels, names, strict=True):
        down, across = axes.planes[name]
        for axis, (readout, values) in zip(line, found[name].items(), strict=False):
            ys = sorted({column[0] for column in values})
            xs = sorted({column[1] for column in values})
            grid = np.full((len(ys), len(xs)), np.nan)
            for (y, x), one in values.items():
                grid[ys.index(y), xs.index(x)] = scale * one
            image = axis.imshow(grid, norm=shades, origin="lower", aspect="auto")
            for (i, j), one in np.ndenumerate(grid):
                if not np.isnan(one):
                    colour = "white" if shades(one) < 0.5 else "black"
                    text = f"{one:.4g}" if one < 1e4 else f"{one:,.0f}"
                    axis.text(j, i, text, ha="center", va="center", color=colour, fontsize=7)
            axis.set_xticks(range(len(xs)), [f"{x:g}" for x in xs])
            axis.set_yticks(range(len(ys)), [f"{y:g}" for y in ys])
            axis.set_xlabel(across.split(".")[-1])
            axis.set_ylabel(down.split(".")[-1])
            axis.set_title(f"{name}, {readout}")
    figure.colorbar(image, ax=panels, label=table.metric.title)
    return figure
