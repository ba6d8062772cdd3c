from typing import Any

import pytest
import torch
from lightning.pytorch.strategies import SingleDeviceStrategy

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.training.checkpoint import CHECKPOINT, Diverged, check_finite
from mops_lightning.zoo import weights
from tests.support.command_line import job

STRATEGY = SingleDeviceStrategy()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_check_finite_names_the_first_value_that_is_not(value):
    moments = torch.ones(2)
    values: dict[str, Any] = {
        "weights": {"w": torch.ones(2), "n": torch.tensor(1)},
        "optimizer": [{"state": {0: {"exp_avg": moments}}, "param_groups": [{}]}],
    }
    check_finite(values, 7, STRATEGY)

    moments[1] = value

    with pytest.raises(Diverged, match=r"optimizer\.0\.state\.0\.exp_avg is not finite at step 7"):
        check_finite(values, 7, STRATEGY)


def test_run_diverged_keeps_last_finite_checkpoint(tmp_path):
    folder = tmp_path / "run"
    path = folder / "checkpoints" / CHECKPOINT
    # The rate explodes after the first epoch.
    rising = ["optimizer=exponential", "optimizer.schedule.end_lr=1e18"]
    said = rf"training diverged(.|\n)*last finite checkpoint is {path}"

    with pytest.raises(UserError, match=said):
        job(folder, "weights=null", "trainer.max_epochs=3", *rising)

    content = torch.load(path, weights_only=True)
    assert weights.first_nonfinite(content["state_dict"]) is None
    assert content["epoch"] < 2
    assert run_record.read(folder).status == "failed"
    assert not (folder / "weights.safetensors").exists()


def test_run_diverged_in_last_step_fails(tmp_path):
    one_step = ["dataset.train_per_class=2", "batch_size=6", "val_fraction=0"]
    settings = ["weights=null", "optimizer.lr=1e18", "callbacks.checkpoint=null"]
    with pytest.raises(UserError, match=r"training diverged: .*Try a lower"):
        job(tmp_path / "run", *one_step, *settings)
    assert run_record.read(tmp_path / "run").status == "failed"
