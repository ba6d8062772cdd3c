import csv
import json

import pytest

from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.report.cli import main
from mops_lightning.tasks.classification import Classification
from tests.support.command_line import TINY, done, runs
from tests.support.reports import put, put_planes, rows


class Doubt(Accuracy):
    """Fraction of wrong answers, per mille."""

    name = "doubt"
    label = "wrong answers"
    unit = "‰"
    scale = 1000.0
    higher_is_better = False
    summary_order = 0

    def compute(self):
        return 1 - super().compute()


class DoubtfulClassification(Classification):
    score = Doubt.name

    def metrics(self, training=False):
        return collection(Doubt(self.num_classes), Accuracy(self.num_classes))


def test_user_metric_appears_in_closing_table_and_report(tmp_path, capsys):
    """Its class declares unit and label; nothing else names it."""
    target = "task._target_=tests.report.test_cli.DoubtfulClassification"
    arguments = [*TINY, "task=classification", target, "sampler=fps", "weights=null"]
    out = done(arguments, tmp_path)
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
    printed = capsys.readouterr().out
    assert (tmp_path / "table.md").read_text() in printed
    assert "nre_cd_planes.png" in printed
    assert (tmp_path / "nre_cd_planes.png").read_bytes()[:4] == b"\x89PNG"
    svg = (tmp_path / "nre_cd_planes.svg").read_text()
    assert "samplenet" in svg or "<path" in svg
    tex = (tmp_path / "table.tex").read_text()
    assert r"1 & 1.5 / 2 & 1.9 / 2 \\" in tex
    assert tex.count(r"\begin{tabular}") == tex.count(r"\end{tabular}") == 2
    with (tmp_path / "table.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 20
    cell = {"sampler.alpha": "1.0", "sampler.tau": "0.9", "readout": "generated"}
    (one,) = [line for line in lines if cell.items() <= line.items()]
    assert {"sampler": "mops", "metric": "nre_cd", "value": "1.9", "m": "32"}.items() <= one.items()
