"""Training and evaluation in mixed precision."""

import json

import pytest

from tests.support.command_line import call, job

NETS = {"classification": "pointnet", "registration": "pcrnet", "reconstruction": "foldingnet"}


@pytest.mark.parametrize("task", NETS)
def test_train_mixed_precision_is_close(task, tmp_path):
    common = [f"task={task}", f"task/net={NETS[task]}", "learn=joint", "weights=null"]
    found = {}
    for precision in ("32-true", "bf16-mixed"):
        record = job(tmp_path / precision, *common, f"trainer.precision={precision}")
        found[precision] = record.metrics["test/generated/subset_distance"]
        assert record.status == "completed"
    assert found["bf16-mixed"] == pytest.approx(found["32-true"], rel=0.2)
    assert found["bf16-mixed"] != found["32-true"]


def test_evaluate_precision_does_not_change_metrics(tmp_path):
    job(tmp_path / "run")
    for name, precision in (("single", "32-true"), ("half", "bf16-mixed")):
        arguments = ["evaluate=run", f"trainer.precision={precision}", f"hydra.run.dir={name}"]
        status, _, err = call(arguments, tmp_path)
        assert status == 0, err
    records = [json.loads((tmp_path / n / "result.json").read_text()) for n in ("single", "half")]
    assert records[0]["metrics"] == records[1]["metrics"]
