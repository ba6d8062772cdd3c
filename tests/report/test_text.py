from mops_lightning.report.text import PAPER, Grid, markdown


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
