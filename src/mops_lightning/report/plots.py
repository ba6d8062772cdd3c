"""Curves and heat maps of a report."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from mops_lightning.records.readout_names import GENERATED_READOUTS, INDEX_READOUT, PROJECTED
from mops_lightning.report.build import Report
from mops_lightning.report.grids import MAX_COLUMNS
from mops_lightning.report.rows import sort_key
from mops_lightning.report.tables import Table
from mops_lightning.viz.figures import new_figure

COLOURS: list[Any] = [f"C{number}" for number in range(10)]
DARK = colormaps["Dark2"]
COLOURS += [DARK(number) for number in range(8)]
"""Of curves, in the order of the rows."""
MARKERS = "os^v"
"""Of curves; another one where all colours are taken."""

LETTERS = 32
LINES = 16
"""Letters in a line of a legend, and lines, that fit beside curves of the usual size."""
LETTER = 0.07
LINE = 0.18
"""Inches that a figure grows for each letter and line more."""

LOG_SCALE_RATIO = 20
"""Heat maps whose largest value exceeds the smallest by more have logarithmic colours."""


def plots(report: Report) -> dict[str, Figure]:
    """Return the figures of a report by file name without suffix."""
    figures: dict[str, Figure] = {}
    for table in report.tables:
        group = table.group
        if group.planes:
            name = _new_name(f"{table.metric.name}_planes", figures)
            figures[name] = heat_maps(table)
        elif group.column != "net" and len(table.columns()) > 1:
            name = _new_name(f"{table.metric.name}_curves", figures)
            figures[name] = curves(table)
    return figures


def _new_name(name: str, figures: Mapping[str, Figure]) -> str:
    """Return a name, with a number behind it if other groups have figures of this name."""
    others = [other for other in figures if other.startswith(name)]
    if not others:
        return name
    return f"{name}_{len(others) + 1}"


def curves(table: Table) -> Figure:
    """Draw a metric against the size or another setting, one panel for each readout.

    Samplers that choose input points are dashed and the same in all panels. Error bars are
    standard deviations over seeds. Panels with many columns are wide, and stacked.
    """
    columns = sorted(table.columns())
    readouts = list(GENERATED_READOUTS)
    if PROJECTED in set(table.values["readout"]):
        readouts.append(PROJECTED)
    number = len(readouts)
    is_wide = len(columns) > MAX_COLUMNS
    if is_wide:
        figure = new_figure(0.16 * len(columns) + 2, 2.2 * number + 1)
        panels = figure.subplots(number, 1, sharex=True)
    else:
        names = table.rows()
        letters = max(len(name) for name in names)
        wider = LETTER * max(letters - LETTERS, 0)
        higher = LINE * max(len(names) - LINES, 0)
        figure = new_figure(4.2 * number + wider, 3.4 + higher)
        panels = figure.subplots(1, number, sharey=True)
    ticks = [_tick(column) for column in columns]
    for axis, readout in zip(panels, readouts, strict=True):
        _draw_curves(axis, table, readout, columns)
        axis.set(title=readout, xlabel=table.group.column, ylabel=table.metric.title)
        axis.set_xticks(range(len(columns)), ticks)
        if is_wide:
            axis.tick_params(axis="x", rotation=90)
        axis.grid(alpha=0.3)
        axis.label_outer()
    _add_legend(panels)
    return figure


def _tick(value: str | float) -> str:
    if isinstance(value, str):
        return value
    return f"{value:g}"


def _draw_curves(axis: Any, table: Table, readout: str, columns: Sequence[Any]) -> None:
    """Draw a curve for each row of a table into the panel of a readout."""
    scale = table.metric.scale
    for number, name in enumerate(table.rows()):
        style = "-"
        shown = readout
        if INDEX_READOUT in table.readouts(name):
            style = "--"
            shown = INDEX_READOUT
        values = table.of(name, shown).sort_values("column")
        if values.empty:
            continue
        deviations = values["std"].fillna(0.0)
        axis.errorbar(
            [columns.index(column) for column in values["column"]],
            values["mean"] * scale,
            yerr=deviations * scale,
            label=name,
            color=COLOURS[number % len(COLOURS)],
            linestyle=style,
            marker=MARKERS[number // len(COLOURS) % len(MARKERS)],
            markersize=3,
            capsize=2,
        )


def _add_legend(panels: Sequence[Any]) -> None:
    """Name the curves of all panels beside the last one, which may lack some of them."""
    curve_of: dict[str, Any] = {}
    for axis in panels:
        curves_of_panel, names = axis.get_legend_handles_labels()
        curve_of |= zip(names, curves_of_panel, strict=True)
    panels[-1].legend(
        curve_of.values(),
        curve_of.keys(),
        fontsize=8,
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
    )


def heat_maps(table: Table) -> Figure:
    """Draw the planes of all samplers, a row each and a column per readout.

    Every row has a colour scale of its own, so that one sampler's values do not hide another's.
    """
    planes = table.planes
    scale = table.metric.scale
    names = sorted(planes, key=sort_key)
    width = max(len(table.readouts(name)) for name in names)
    figure = new_figure(3.6 * width + 1, 3.2 * len(names))
    panels = figure.subplots(len(names), width, squeeze=False)
    for line, name in zip(panels, names, strict=True):
        down, across = (key.rpartition(".")[2] for key in planes[name])
        of_row = table.values[table.values["row"] == name]
        norm = _colour_scale(of_row["mean"] * scale)
        readouts = table.readouts(name)
        for axis in line[len(readouts) :]:
            axis.set_axis_off()
        for axis, readout in zip(line, readouts, strict=False):
            values = table.of(name, readout)
            plane = values.pivot(index="down", columns="column", values="mean")
            in_order = plane.sort_index().sort_index(axis=1)
            image = _heat_map(axis, in_order * scale, norm)
            axis.set(xlabel=across, ylabel=down, title=f"{name}, {readout}")
        figure.colorbar(image, ax=line, label=table.metric.title)
    return figure


def _colour_scale(means: pd.Series) -> Normalize:
    """Return the colour scale of values; a logarithmic one if they differ much."""
    low = means.min()
    high = means.max()
    # On a linear scale, one large value would hide the differences of all others.
    if 0 < LOG_SCALE_RATIO * low < high:
        return LogNorm(low, high)
    return Normalize(low, high)


def _heat_map(axis: Any, plane: pd.DataFrame, norm: Normalize) -> Any:
    """Draw a plane with its numbers; return the image."""
    cells = plane.to_numpy()
    for (row, column), value in np.ndenumerate(cells):
        if np.isnan(value):
            continue
        text = f"{value:,.0f}"
        if value < 1e4:
            text = f"{value:.4g}"
        colour = "black"
        if norm(value) < 0.5:
            colour = "white"
        axis.text(column, row, text, ha="center", va="center", color=colour, fontsize=7)
    rows, columns = cells.shape
    axis.set_xticks(range(columns), [_tick(x) for x in plane.columns])
    axis.set_yticks(range(rows), [_tick(y) for y in plane.index])
    return axis.imshow(cells, norm=norm, origin="lower", aspect="auto")
