import csv
import json

import pytest

from mops_lightning.report.cli import main
from tests.support.command_line import TINY, call, runs
from tests.support.reports import put, put_planes, rows


def test_user_metric_appears_in_closing_table_and_report(tmp_path, capsys):
    """Its class declares unit and label; nothing else names it."""
    target = "task._target_=tests.support.made_up.DoubtfulClassification"
    status, out, err = call(
        [*TINY, "task=classification", target, "sampler=fps", "weights=null"], tmp_path
    )
    assert status == 0, err
    closing = [line for line in out.splitlines() if "sampled by" in line]
    assert "wrong answers (‰)" in closing[0]
    assert closing[0].index("wrong answers") < closing[0].index("accuracy (%)")
    (run,) = runs(tmp_path)
    value = json.loads((run / "result.json").read_text())["metrics"]["test/sampled/doubt"]
    main([str(run)])
    text = capsys.readouterr().out
    assert text.startswith("Test wrong answers (‰): classification")
    assert ["fps", f"{1000 * value:.2f}"] in rows(text)


def test_report_of_folder_without_records_names_it(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main([str(tmp_path)])
    assert stop.value.code == 2
    assert str(tmp_path) in capsys.readouterr().err


def test_report_of_names_that_are_no_text_is_written_and_printed(tmp_path, capsys):
    odd = {"device": "\ud800", "recipe": {"name": ["fast"]}}
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3}, **odd)
    main([str(tmp_path)])
    assert (tmp_path / "table.md").read_text() in capsys.readouterr().out
    assert "\\ud800" in (tmp_path / "table.csv").read_text()
    assert "\\ud800" in (tmp_path / "report.html").read_text()


def test_report_writes_all_files(tmp_path, capsys):
    put_planes(tmp_path)
    main([str(tmp_path)])
    assert "nre_cd_planes.png" in capsys.readouterr().out
    assert (tmp_path / "nre_cd_planes.png").read_bytes()[:4] == b"\x89PNG"
    svg = (tmp_path / "nre_cd_planes.svg").read_text()
    assert "samplenet" in svg or "<path" in svg
    tex = (tmp_path / "table.tex").read_text()
    assert r"1 & 1.5 / 2 & 1.9 / 2 \\" in tex
    assert tex.count(r"\begin{tabular}") == tex.count(r"\end{tabular}") == 2
    with (tmp_path / "table.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 20
    (one,) = [
        line
        for line in lines
        if (line["sampler.alpha"], line["sampler.tau"], line["readout"])
        == ("1.0", "0.9", "generated")
    ]
    assert (one["sampler"], one["metric"], one["value"], one["m"]) == (
        "mops",
        "nre_cd",
        "1.9",
        "32",
    )
