"""Training and evaluation in mixed precision."""

import json

import pytest

from mops_lightning.config.compose import compose
from mops_lightning.training.run.run import run
from tests.support.command_line import TINY_WITH_PICTURES, call

NETS = {
    "classification": ("pointnet",),
    "registration": ("pcrnet",),
    "reconstruction": ("foldingnet", "atlasnet"),
}


@pytest.mark.parametrize("task", NETS)
def test_train_mixed_precision_is_close(task, tmp_path):
    for net in NETS[task]:
        common = [
            *TINY_WITH_PICTURES,
            f"task={task}",
            f"task/net={net}",
            "pictures=0",
            "logger=none",
        ]
        common += ["learn=joint", "weights=null", f"cache={tmp_path}/cache"]
        found = {}
        for precision in ("32-true", "bf16-mixed"):
            chosen = [*common, f"trainer.precision={precision}"]
            record = run(compose(chosen), tmp_path / net / precision, chosen)
            found[precision] = record.metrics["test/generated/subset_distance"]
            assert record.status == "completed"
        assert found["bf16-mixed"] == pytest.approx(found["32-true"], rel=0.2)
        assert found["bf16-mixed"] != found["32-true"]


def test_evaluate_precision_does_not_change_metrics(tmp_path):
    overrides = [*TINY_WITH_PICTURES, "pictures=0", "logger=none", f"cache={tmp_path}/cache"]
    status, _, err = call([*overrides, "hydra.run.dir=run"], tmp_path)
    assert status == 0, err
    for name, precision in (("single", "32-true"), ("half", "bf16-mixed")):
        arguments = ["evaluate=run", f"trainer.precision={precision}", f"hydra.run.dir={name}"]
        status, _, err = call(arguments, tmp_path)
        assert status == 0, err
    records = [json.loads((tmp_path / n / "result.json").read_text()) for n in ("single", "half")]
    assert records[0]["metrics"] == records[1]["metrics"]


def test_precision_gpu_only_on_cpu_raises(tmp_path):
    status, _, err = call([*TINY_WITH_PICTURES, "trainer.precision=16-mixed"], tmp_path)
    assert status != 0
    assert "trainer.precision=bf16-mixed" in err
