"""Training and evaluation in mixed precision."""

import pytest

from mops_lightning.records import run_record
from tests.support.command_line import done, job

NETS = {"classification": "pointnet", "registration": "pcrnet", "reconstruction": "foldingnet"}


@pytest.mark.parametrize("task", NETS)
def test_train_mixed_precision_is_close(task, tmp_path):
    common = [f"task={task}", f"task/net={NETS[task]}", "learn=joint", "weights=null"]
    found = {}
    for precision in ("32-true", "bf16-mixed"):
        record = job(
            tmp_path / precision, *common, "baselines={}", f"trainer.precision={precision}"
        )
        found[precision] = record.metrics["test/generated/subset_distance"]
        assert record.status == "completed"
    assert found["bf16-mixed"] == pytest.approx(found["32-true"], rel=0.2)
    assert found["bf16-mixed"] != found["32-true"]


def test_evaluate_precision_does_not_change_metrics(tmp_path):
    trained = job(tmp_path / "run")
    half = ["evaluate=run", "trainer.precision=bf16-mixed", "hydra.run.dir=half"]
    done(half, tmp_path)
    assert run_record.read(tmp_path / "half").metrics == trained.metrics
