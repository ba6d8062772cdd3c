import re

from mops_lightning.report.tables import Cell, Part
from mops_lightning.report.text import PAPER, Grid, latex, markdown


def test_markdown_escapes_names():
    grid = Grid("a*b*", ["x|y", "<b>"], [["`n`\nm", "[l](u)"], [PAPER, "1"]], ["p_q|r"])
    lines = markdown([grid], ["- folder|one: line\nline"]).splitlines()
    assert lines == [
        "a&#42;b&#42;",
        "",
        "| x&#124;y | &#60;b> |",
        "|---|--:|",
        "| &#96;n&#96; m | &#91;l](u) |",
        "| *the paper's* | 1 |",
        "",
        "p_q&#124;r",
        "",
        "- folder&#124;one: line line",
    ]


def test_latex_escapes_names():
    grid = Grid(
        "50 % of $x_1$", [r"a\b", "c"], [["{n}\nm & <o>", "1 ± 2"], [PAPER, "~3^"]], ["p\nq"]
    )
    text = latex([grid], ["- folder\nline"])
    assert r"\caption{50 \% of \$x\_1\$}" in text
    assert "a\\textbackslash{}b & c \\\\\n" in text
    assert "\\{n\\} m \\& $<$o$>$ & 1 $\\pm$ 2 \\\\\n" in text
    assert "\\emph{the paper's} & \\textasciitilde{}3\\textasciicircum{} \\\\\n" in text
    assert "% p q\n" in text
    assert text.endswith("% - folder line\n")


def test_marks_of_ranked_values():
    cell = Cell((Part("1 % ± 2", 1), Part("3", 2), Part("4")), " (n=2)")
    grid = Grid("title", ["a", "b"], [["x", cell]])
    assert "| x | **1 % ± 2** / <u>3</u> / 4 (n=2) |" in markdown([grid], [])
    text = latex([grid], [])
    assert "x & \\textbf{1 \\% $\\pm$ 2} / \\underline{3} / 4 (n=2) \\\\\n" in text


def test_latex_is_ascii_with_balanced_groups_whatever_names_are():
    names = ["[x]", "τ=ü", "{", "}", "\\", "a\x1b[31m", "\u202e"]
    grid = Grid("β % {", ["[h", *names], [["[row", *names]], names)
    text = latex([grid], names)
    assert text.isascii()
    body = re.sub(r"(?m)^%.*$|\\\\|\\[{}]", "", text)
    assert body.count("{") == body.count("}")
    assert not re.search(r"\\\\\n\[", text), "an optional argument"


def test_markdown_of_hostile_names_is_printable():
    text = markdown([Grid("t", ["a"], [["\x1b[31mred\x07"]], ["\x9b0m"])], ["\x1b]0;title"])
    assert all(one.isprintable() or one == "\n" for one in text)
