import json

from mops_lightning.report.cli import main
from tests.support.command_line import TINY, call, runs
from tests.support.reports import rows


def test_user_metric_appears_in_closing_table_and_report(tmp_path, capsys):
    """Its class declares unit and label; nothing else names it."""
    target = "task._target_=tests.support.made_up.DoubtfulClassification"
    status, out, err = call([*TINY, target, "sampler=fps", "weights=null"], tmp_path)
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
