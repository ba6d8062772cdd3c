"""Curves, heat maps and clouds of a report."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from mops_lightning.records.readout_names import GENERATED_READOUTS, INDEX_READOUT
from mops_lightning.report.axes import Axes, row, value
from mops_lightning.report.build import Report
from mops_lightning.report.cells import Cells, sort_key
from mops_lightning.viz.clouds import draw_cloud, upright
from mops_lightning.viz.figures import cloud_axes, new_figure
from mops_lightning.viz.snapshots import INPUT, load_clouds

COLOURS = (*(f"C{i}" for i in range(10)), *(colormaps["Dark2"](i) for i in range(8)))
"""Of curves, in the order of the rows."""

LOG_SCALE_RATIO = 20
"""Heat maps whose largest value exceeds the smallest by more have logarithmic colours."""


def plots(report: Report) -> dict[str, Figure]:
    """Return the figures of a report by file name without suffix."""
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
    """Draw the first saved cloud of every sampler at every value of a setting, such as noise."""
    found: dict[str, dict[Any, Path]] = {}
    for record in report.scored:
        path = Path(record.folder) / record.files.get("clouds", "")
        if path.is_file():
            name = row(record, report.names["net"])
            found.setdefault(name, {}).setdefault(value(record, report.axes.column), path)
    columns = sorted({column for paths in found.values() for column in paths})
    if not columns:
        return None
    figure = new_figure(2.6 * len(columns), 2.6 * len(found), "tight")
    for i, name in enumerate(sorted(found, key=sort_key)):
        for j, column in enumerate(columns):
            if column not in found[name]:
                continue
            _, arrays = load_clouds(found[name][column])
            cloud = upright(arrays.pop(INPUT)[0])
            readout, samples = next(iter(arrays.items()))
            title = f"{report.axes.column}={column:g}" if i == 0 else ""
            below = f"{name}, {readout}"
            axes = cloud_axes(figure, len(found), len(columns), i, j, title, below)
            draw_cloud(axes, cloud, upright(samples[0]), readout)
    return figure


def curves(table: Cells, axes: Axes) -> Figure:
    """Draw a metric against the size or another setting, one panel for each readout.

    Samplers that choose input points are dashed and the same in all panels. Error bars are
    standard deviations over seeds.
    """
    figure = new_figure(4.2 * len(GENERATED_READOUTS), 3.4)
    panels = figure.subplots(1, len(GENERATED_READOUTS), sharey=True)
    columns = table.columns()[::-1]
    for axis, readout in zip(panels, GENERATED_READOUTS, strict=True):
        for number, name in enumerate(table.rows()):
            cells = table.values[name]
            # Index samplers have one readout for all panels.
            dashed = INDEX_READOUT in next(iter(cells.values()))
            key = INDEX_READOUT if dashed else readout
            xs = [column for column in columns if cells.get(column, {}).get(key)]
            if not xs:
                continue
            values = [np.array(list(cells[x][key].values())) * table.metric.scale for x in xs]
            axis.errorbar(
                [columns.index(x) for x in xs],
                [one.mean() for one in values],
                yerr=[one.std(ddof=1) if len(one) > 1 else 0.0 for one in values],
                label=name,
                color=COLOURS[number % len(COLOURS)],
                linestyle="--" if dashed else "-",
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


def heat_maps(table: Cells, axes: Axes) -> Figure:
    """Draw the planes of all samplers, a row each and a column per readout, on one colour scale."""
    assert axes.planes is not None
    names = sorted(axes.planes, key=sort_key)
    found = {name: table.plane(name) for name in names}
    everything = [one for by in found.values() for values in by.values() for one in values.values()]
    scale = table.metric.scale
    norm = _colour_scale(scale * min(everything), scale * max(everything))
    width = max(len(by) for by in found.values())
    figure = new_figure(3.6 * width + 1, 3.2 * len(names))
    panels = figure.subplots(len(names), width, squeeze=False)
    for line, name in zip(panels, names, strict=True):
        down, across = (key.split(".")[-1] for key in axes.planes[name])
        for axis, (readout, values) in zip(line, found[name].items(), strict=False):
            image = _heat_map(axis, {place: scale * one for place, one in values.items()}, norm)
            axis.set(xlabel=across, ylabel=down, title=f"{name}, {readout}")
    figure.colorbar(image, ax=panels, label=table.metric.title)
    return figure


def _colour_scale(low: float, high: float) -> Normalize:
    """Return a logarithmic scale if one value would hide the differences of all others."""
    logarithmic = low > 0 and high > LOG_SCALE_RATIO * low
    return LogNorm(low, high) if logarithmic else Normalize(low, high)


def _heat_map(axis: Any, values: dict[Any, float], norm: Normalize) -> Any:
    """Draw values by (y, x) with their numbers; return the image."""
    ys = sorted({y for y, _ in values})
    xs = sorted({x for _, x in values})
    grid = np.full((len(ys), len(xs)), np.nan)
    for (y, x), one in values.items():
        grid[ys.index(y), xs.index(x)] = one
    for (i, j), one in np.ndenumerate(grid):
        if not np.isnan(one):
            colour = "white" if norm(one) < 0.5 else "black"
            text = f"{one:.4g}" if one < 1e4 else f"{one:,.0f}"
            axis.text(j, i, text, ha="center", va="center", color=colour, fontsize=7)
    axis.set_xticks(range(len(xs)), [f"{x:g}" for x in xs])
    axis.set_yticks(range(len(ys)), [f"{y:g}" for y in ys])
    return axis.imshow(grid, norm=norm, origin="lower", aspect="auto")
