"""Curves and heat maps of a report's tables."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mops_lightning import units
from mops_lightning.readout_names import GENERATED_READOUTS, INDEX_READOUT
from mops_lightning.report.axes import Axes
from mops_lightning.report.build import Report, plane
from mops_lightning.report.cells import Cells, place


def plots(report: Report) -> dict[str, Figure]:
    """Return the figures of all tables by the name of their file, without its suffix."""
    figures = {}
    for table in report.tables:
        if report.axes.planes:
            figures[f"{table.metric}_planes"] = heat_maps(table, report.axes)
        elif len(table.columns()) > 1:
            figures[f"{table.metric}_curves"] = curves(table, report.axes)
    return figures


def curves(table: Cells, axes: Axes) -> Figure:
    """Draw a metric against the size or another setting, one panel for each readout.

    Samplers that choose input points are dashed and the same in all panels. Bars are standard
    deviations over seeds.
    """
    figure = Figure(figsize=(4.2 * len(GENERATED_READOUTS), 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(GENERATED_READOUTS), sharey=True)
    columns = table.columns()[::-1]
    scale = 100.0 if units.unit(table.metric) == "%" else 1.0
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
    panels[0].set_ylabel(units.title(table.metric))
    panels[-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def heat_maps(table: Cells, axes: Axes) -> Figure:
    """Draw the planes of all samplers, one row each, a column for each readout, in one scale."""
    assert axes.planes is not None
    names = sorted(axes.planes, key=place)
    found = {name: plane(table, name) for name in names}
    everything = [one for by in found.values() for values in by.values() for one in values.values()]
    scale = 100.0 if units.unit(table.metric) == "%" else 1.0
    low, high = scale * min(everything), scale * max(everything)
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
            image = axis.imshow(grid, vmin=low, vmax=high, origin="lower", aspect="auto")
            for (i, j), one in np.ndenumerate(grid):
                if not np.isnan(one):
                    light = one < (low + high) / 2
                    colour = "white" if light else "black"
                    axis.text(
                        j, i, f"{one:.3g}", ha="center", va="center", color=colour, fontsize=7
                    )
            axis.set_xticks(range(len(xs)), [f"{x:g}" for x in xs])
            axis.set_yticks(range(len(ys)), [f"{y:g}" for y in ys])
            axis.set_xlabel(across.split(".")[-1])
            axis.set_ylabel(down.split(".")[-1])
            axis.set_title(f"{name}, {readout}")
    figure.colorbar(image, ax=panels, label=units.title(table.metric))
    return figure
