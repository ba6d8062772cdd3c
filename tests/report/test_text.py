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
