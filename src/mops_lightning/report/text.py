"""Tables as Markdown, LaTeX and CSV."""

import csv
import io
from dataclasses import dataclass, field

from mops_lightning.records.readout_names import parse, parse_transfer
from mops_lightning.records.run_record import RunRecord
from mops_lightning.report.axes import row, value
from mops_lightning.report.collect import epochs, seed, trained_with

PAPER = "*the paper's*"
"""Label of a row with the paper's values for the sampler in the row above."""


@dataclass
class Grid:
    """A table as text.

    Attributes:
        title: a caption.
        head: names of the columns, starting with that of the row labels.
        rows: their cells.
        below: lines under the table.
    """

    title: str
    head: list[str]
    rows: list[list[str]]
    below: list[str] = field(default_factory=list)


def markdown(grids: list[Grid], remarks: list[str]) -> str:
    """Return all tables and the remarks."""
    lines: list[str] = []
    for grid in grids:
        title, *below = map(_escaped, (grid.title, *grid.below))
        lines += [title, "", _line(grid.head), "|---|" + "--:|" * (len(grid.head) - 1)]
        lines += [*map(_line, grid.rows), "", *below, *([""] if below else [])]
    return "\n".join([*lines, *map(_escaped, remarks)]) + "\n"


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cell if cell == PAPER else _escaped(cell) for cell in cells)} |"


SPECIAL = {ord(letter): f"&#{ord(letter)};" for letter in "&|<*`["}
"""Characters with a meaning in Markdown, which names may contain."""


def _escaped(text: str) -> str:
    return " ".join(text.splitlines()).translate(SPECIAL)


TEX = {letter: f"\\{letter}" for letter in "&%_#${}"} | {
    "\\": r"\textbackslash{}",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": "$<$",
    ">": "$>$",
    "°": r"$^\circ$",
    "±": r"$\pm$",
}


def latex(grids: list[Grid], remarks: list[str]) -> str:
    """Return all tables as ``tabular`` environments (package booktabs); remarks as comments."""
    parts = []
    for grid in grids:
        body = "\n".join(f"{' & '.join(map(_tex, cells))} \\\\" for cells in grid.rows)
        parts.append(
            "\\begin{table}\n\\centering\n"
            f"\\caption{{{_tex(grid.title)}}}\n"
            f"\\begin{{tabular}}{{l{'r' * (len(grid.head) - 1)}}}\n\\toprule\n"
            f"{' & '.join(map(_tex, grid.head))} \\\\\n\\midrule\n{body}\n\\bottomrule\n"
            "\\end{tabular}\n\\end{table}\n" + _comments(grid.below)
        )
    return "\n".join(parts) + _comments(remarks)


def _comments(lines: list[str]) -> str:
    return "".join(f"% {' '.join(line.split())}\n" for line in lines)


def _tex(text: str) -> str:
    if text.startswith("*") and text.endswith("*"):
        return f"\\emph{{{_tex(text[1:-1])}}}"
    return "".join(TEX.get(letter, letter) for letter in " ".join(text.splitlines()))


def long_csv(found: list[RunRecord], net: str, keys: list[str]) -> str:
    """Return one line for every test value of every record.

    The column ``net`` is there if some values are those of further task nets (``task_nets``).

    Args:
        found: completed records.
        net: the table's task net.
        keys: settings that get a column, dotted.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    fixed = ["folder", "sampler", "learn", "seed", "epochs", "m", "readout", "metric", "value"]
    has_nets = any(parse_transfer(name) for record in found for name in record.metrics)
    writer.writerow([*fixed, *keys, *(["net"] if has_nets else []), "commit", "device"])
    for record in found:
        for name, figure in record.metrics.items():
            other, parts = parse_transfer(name) or (record.config["names"]["net"], parse(name))
            if parts is None or figure is None:
                continue
            writer.writerow(
                [
                    record.folder,
                    row(record, net),
                    trained_with(record),
                    seed(record),
                    epochs(record) or 0,
                    parts.m or record.config.get("m"),
                    parts.readout,
                    parts.metric,
                    repr(figure),
                    *(value(record, key) for key in keys),
                    *([other] if has_nets else []),
                    record.git["commit"],
                    record.device,
                ]
            )
    return out.getvalue()
