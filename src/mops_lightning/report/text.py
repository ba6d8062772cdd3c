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
    texts = []
    for part in cell.parts:
        mark = marks.get(part.rank, "{}")
        texts.append(mark.format(escape(part.text)))
    return " / ".join(texts) + escape(cell.suffix)


def markdown(grids: list[Grid], remarks: list[str]) -> str:
    """Return all tables and the remarks."""
    lines: list[str] = []
    for grid in grids:
        lines += [_escaped(grid.title), ""]
        lines.append(_line(grid.head))
        lines.append(_rule(len(grid.head)))
        lines += [_line(row) for row in grid.rows]
        lines.append("")
        if grid.below:
            lines += [_escaped(line) for line in grid.below]
            lines.append("")
    lines += [_escaped(remark) for remark in remarks]
    return printable("\n".join(lines) + "\n")


def _line(cells: Sequence[str | Cell]) -> str:
    texts = [_cell(cell) for cell in cells]
    return f"| {' | '.join(texts)} |"


def _cell(cell: str | Cell) -> str:
    if cell == PAPER:
        return PAPER
    return marked(cell, _escaped, "**{}**", "<u>{}</u>")


def _rule(columns: int) -> str:
    """Return the line under the head, which aligns all columns but the first to the right."""
    return "|---|" + "--:|" * (columns - 1)


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
        lines = [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{_tex(grid.title)}}}",
            rf"\begin{{tabular}}{{l{'r' * (len(grid.head) - 1)}}}",
            r"\toprule",
            _tex_line(grid.head),
            r"\midrule",
            *(_tex_line(row) for row in grid.rows),
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
        ]
        text = "\n".join(lines)
        parts.append(f"{text}\n{_comments(grid.below)}")
    return "\n".join(parts) + _comments(remarks)


def _comments(lines: list[str]) -> str:
    texts = [" ".join(line.split()) for line in lines]
    return "".join(f"% {_ascii(text)}\n" for text in texts)


def _tex_line(cells: Sequence[str | Cell]) -> str:
    texts = [marked(cell, _tex, r"\textbf{{{}}}", r"\underline{{{}}}") for cell in cells]
    return f"{' & '.join(texts)} \\\\"


def _tex(text: str) -> str:
    if text.startswith("*") and text.endswith("*"):
        inside = _tex(text[1:-1])
        return f"\\emph{{{inside}}}"
    line = " ".join(text.splitlines())
    letters = [TEX.get(letter) or _ascii(letter) for letter in line]
    return "".join(letters)


def _ascii(text: str) -> str:
    """Return a text whose letters every TeX engine knows; others become question marks."""
    return text.encode("ascii", "replace").decode()
