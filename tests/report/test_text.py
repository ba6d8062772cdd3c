import re

from mops_lightning.report.build import build_report
from mops_lightning.report.tables import Cell, Part
from mops_lightning.report.text import PAPER, Grid, latex, markdown
from tests.support.reports import put, put_pairs


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


def test_latex_tables_are_well_formed(tmp_path):
    """Environments nest, rows have as many cells as columns, and no letter is special."""
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3, "test/full/accuracy": 0.9})
    put(tmp_path, "mops", 8, {"test/generated/accuracy": 0.8, "test/matched/accuracy": 0.7})
    put_pairs(tmp_path, "a_b&c #1", 32, 12.0)
    report = build_report(tmp_path)
    text = latex(report.grids, report.remarks)
    opened: list[str] = []
    width = 0
    for line in re.sub(r"(?m)^%.*\n", "", text).splitlines():
        if begun := re.match(r"\\begin\{(\w+)\}(?:\{(l?r*)\})?$", line):
            opened.append(begun[1])
            width = len(begun[2] or "")
        elif ended := re.match(r"\\end\{(\w+)\}$", line):
            assert opened.pop() == ended[1]
        elif opened == ["table", "tabular"] and line.endswith(r"\\"):
            assert len(re.findall(r"(?<!\\)&", line)) == width - 1
        plain = re.sub(r"\\[&%_#${}]|\$[^$]*\$", "", line)
        assert not re.search(r"[%_#$^~]", plain), line
    assert opened == []
    assert text.count(r"\begin{tabular}") == 2


def test_markdown_of_hostile_names_is_printable():
    text = markdown([Grid("t", ["a"], [["\x1b[31mred\x07"]], ["\x9b0m"])], ["\x1b]0;title"])
    assert all(one.isprintable() or one == "\n" for one in text)
