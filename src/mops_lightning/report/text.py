"""Tables as Markdown and LaTeX."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from mops_lightning.errors import printable
from mops_lightning.report.tables import Cell

PAPER = "*the paper's*"
"""Label of a row with the paper's values for the sampler in the row above."""

BEST = 1
SECOND = 2
"""Ranks of the values that are set in bold and underlined."""


@dataclass
class Grid:
    """A table as text.

    Attributes:
        title: a caption.
        head: names of the columns; the first column holds the row labels.
        rows: their cells.
        below: lines under the table.
    """

    title: str
    head: list[str]
    rows: Sequence[Sequence[str | Cell]]
    below: list[str] = field(default_factory=list)


def marked(cell: str | Cell, escape: Callable[[str], str], best: str, second: str) -> str:
    """Return a cell as text, with its best and second values marked.

    Args:
        cell: a text, or ranked values.
        escape: escapes a text.
        best: the markup of the best value, with ``{}`` for the value.
        second: the markup of the second.
    """
    if isinstance(cell, str):
        return escape(cell)
    marks = {BEST: best, SECOND: second}
    texts = (marks.get(part.rank, "{}").format(escape(part.text)) for part in cell.parts)
    return " / ".join(texts) + escape(cell.suffix)


def markdown(grids: list[Grid], remarks: list[str]) -> str:
    """Return all tables and the remarks."""
    lines: list[str] = []
    for grid in grids:
        title, *below = map(_escaped, (grid.title, *grid.below))
        lines += [title, "", _line(grid.head), "|---|" + "--:|" * (len(grid.head) - 1)]
        lines += [*map(_line, grid.rows), "", *below, *([""] if below else [])]
    return printable("\n".join([*lines, *map(_escaped, remarks)]) + "\n")


def _line(cells: Sequence[str | Cell]) -> str:
    texts = (one if one == PAPER else marked(one, _escaped, "**{}**", "<u>{}</u>") for one in cells)
    return f"| {' | '.join(map(str, texts))} |"


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
    "[": "{[}",  # no optional argument of the line before
    "°": r"$^\circ$",
    "±": r"$\pm$",
}


def latex(grids: list[Grid], remarks: list[str]) -> str:
    r"""Return all tables as ``tabular`` environments, for ``\input``; remarks as comments."""
    parts = ["% needs \\usepackage{booktabs}\n"]
    for grid in grids:
        body = "\n".join(f"{' & '.join(map(_tex_cell, cells))} \\\\" for cells in grid.rows)
        parts.append(
            "\\begin{table}\n\\centering\n"
            f"\\caption{{{_tex(grid.title)}}}\n"
            f"\\begin{{tabular}}{{l{'r' * (len(grid.head) - 1)}}}\n\\toprule\n"
            f"{' & '.join(map(_tex, grid.head))} \\\\\n\\midrule\n{body}\n\\bottomrule\n"
            "\\end{tabular}\n\\end{table}\n" + _comments(grid.below)
        )
    return "\n".join(parts) + _comments(remarks)


def _comments(lines: list[str]) -> str:
    return "".join(f"% {_ascii(' '.join(line.split()))}\n" for line in lines)


def _tex_cell(cell: str | Cell) -> str:
    return marked(cell, _tex, r"\textbf{{{}}}", r"\underline{{{}}}")


def _tex(text: str) -> str:
    if text.startswith("*") and text.endswith("*"):
        return f"\\emph{{{_tex(text[1:-1])}}}"
    return "".join(TEX.get(letter) or _ascii(letter) for letter in " ".join(text.splitlines()))


def _ascii(text: str) -> str:
    """Return a text whose letters every TeX engine knows; others become question marks."""
    return text.encode("ascii", "replace").decode()
