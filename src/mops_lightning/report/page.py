"""A report as one self-contained HTML page: sortable tables, plots, clouds in 3-D."""

import base64
import hashlib
import html
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from mops_lightning.errors import UserError
from mops_lightning.report.build import Report
from mops_lightning.report.text import PAPER, Grid, marked
from mops_lightning.viz.figures import COLOURS, INPUT, INPUT_COLOUR, load_clouds

MAX_RUNS = 24
"""Most runs whose clouds are in a page; more make it too large to open."""

PLOTLY = "package_data/plotly.min.js"

VIEW = """<h2>Sampled clouds</h2>
<p><label>{choice} <select id="run"></select></label>
<label>Cloud <select id="shape"></select></label>
Drag to rotate; click a name in the legend to hide it.</p>
<div id="view"></div>"""


def page(report: Report, folder: Path, plots: Sequence[Path]) -> str:
    """Return the page.

    Args:
        report: its content.
        folder: the folder of the report; its name is the title.
        plots: SVG files.
    """
    clouds, damaged = _clouds(report, folder)
    name = folder.resolve().name
    remarks = [*report.remarks, *damaged]
    return render(name, report.grids, clouds, remarks, "How the runs were made", plots)


def render(
    title: str,
    grids: Sequence[Grid],
    clouds: Sequence[Mapping[str, Any]],
    remarks: Sequence[str],
    remarks_title: str,
    plots: Sequence[Path] = (),
    choice: str = "Run",
) -> str:
    """Return a page.

    Args:
        title: its heading.
        grids: its tables.
        clouds: groups of clouds with ``name``, ``titles`` of its K clouds, and ``points``
            ``(K, n, 3)`` and ``colours`` by readout, y up; a click shows ``hidden`` readouts.
        remarks: lines at the end.
        remarks_title: their heading.
        plots: SVG files.
        choice: what a group of clouds is called.
    """
    own = files("mops_lightning.report")
    template = Template(own.joinpath("page.html").read_text())
    script = own.joinpath("page.js").read_text()
    plotly = ""
    view = ""
    if clouds:
        plotly = files("plotly").joinpath(PLOTLY).read_text()
        view = VIEW.format(choice=html.escape(choice))
    shown_remarks = [_remark(remark) for remark in remarks if remark]
    return template.substitute(
        title=html.escape(title),
        tables="\n".join(map(_table, grids)),
        plots="\n".join(map(_image, plots)),
        clouds=view,
        remarks_title=html.escape(remarks_title),
        remarks="".join(shown_remarks),
        policy=_policy(script, plotly),
        plotly=plotly,
        script=script,
        # "</script>" in a title must not end the script.
        data=json.dumps(list(clouds)).replace("<", "\\u003c"),
    )


def _policy(script: str, plotly: str) -> str:
    """Return a Content-Security-Policy that runs these scripts only and loads nothing.

    WebGL in plotly compiles functions, for which it needs ``unsafe-eval``.
    """
    allowed = [_hash(script)]
    if plotly:
        allowed += [_hash(plotly), "'unsafe-eval'"]
    scripts = " ".join(allowed)
    return (
        f"default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; img-src data: blob:"
    )


def _hash(script: str) -> str:
    """Return the hash of a script, as a policy names it."""
    digest = hashlib.sha256(script.encode()).digest()
    text = base64.b64encode(digest).decode()
    return f"'sha256-{text}'"


def _remark(line: str) -> str:
    """Return a remark as an item of the list, or as a paragraph that interrupts it."""
    if line.startswith("- "):
        item = line.removeprefix("- ")
        return f"<li>{html.escape(item)}</li>"
    return f"</ul><p>{html.escape(line)}</p><ul>"


def _table(grid: Grid) -> str:
    rows: list[list[str]] = []
    for cells in grid.rows:
        texts = [marked(cell, html.escape, "<b>{}</b>", "<u>{}</u>") for cell in cells]
        if cells[0] == PAPER:
            # Part of the row above, so that sorting keeps them together.
            rows[-1] = _with_papers(rows[-1], texts)
        else:
            rows.append(texts)
    names = [html.escape(name.strip("*")) for name in grid.head]
    head = _tagged("th", names)
    body = "\n".join(f"<tr>{_tagged('td', cells)}</tr>" for cells in rows)
    below = _tagged("p", [html.escape(line) for line in grid.below])
    title = html.escape(grid.title)
    return (
        f"<p>{title}</p>\n"
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>\n{below}"
    )


def _with_papers(ours: Sequence[str], theirs: Sequence[str]) -> list[str]:
    """Return the cells of a row with the paper's in small type below them."""
    cells = []
    for cell, published in zip(ours, theirs, strict=True):
        small = ""
        if published:
            small = f"<small>{published.strip('*')}</small>"
        cells.append(cell + small)
    return cells


def _tagged(tag: str, texts: Sequence[str]) -> str:
    elements = [f"<{tag}>{text}</{tag}>" for text in texts]
    return "".join(elements)


def _image(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    title = html.escape(path.stem)
    return f'<img alt="{title}" src="data:image/svg+xml;base64,{data}">'


def _clouds(report: Report, folder: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the clouds that the runs have saved, as plain data, and a line for damaged files."""
    groups: list[dict[str, Any]] = []
    damaged: list[str] = []
    for record in report.found.done:
        run = Path(record.folder)
        path = run / record.files.get("clouds", "")
        if not path.is_file() or len(groups) == MAX_RUNS:
            continue
        name = str(run.relative_to(folder))
        try:
            groups.append(_group_of_clouds(path, name))
        except (OSError, UserError) as error:
            damaged.append(f"- {error}")
    return groups, damaged


def _group_of_clouds(path: Path, name: str) -> dict[str, Any]:
    """Return the clouds of a run's file as plain data; see ``render``."""
    colours = {INPUT: INPUT_COLOUR, **COLOURS}
    titles, arrays = load_clouds(path)
    points = {}
    shown_in = {}
    for readout, array in arrays.items():
        rounded = array.astype(float).round(3)
        points[readout] = rounded.tolist()
        colour = colours.get(readout, COLOURS["sampled"])
        shown_in[readout] = f"rgb{colour}"
    return {
        "name": name,
        "titles": titles,
        "points": points,
        "colours": shown_in,
        # Completed sets contain the matched points and would hide them.
        "hidden": ["completed"],
    }
