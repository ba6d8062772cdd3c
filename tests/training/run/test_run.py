import time
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.records import run_record
from mops_lightning.training.checkpoint import CHECKPOINT
from mops_lightning.training.run.checkpoint_io import AtomicCheckpointIO
from mops_lightning.training.run.recorded import recorded
from tests.support.command_line import job


def plain(overrides: list[str]) -> Any:
    return OmegaConf.to_container(compose(overrides), resolve=True)


def test_recorded_running_then_completed(tmp_path):
    before = time.perf_counter()
    with recorded(plain(["seed=4"]), tmp_path, ["seed=4"]) as record:
        assert run_record.read(tmp_path).status == "running"
        record.metrics["test/generated/accuracy"] = 0.5
    found = run_record.read(tmp_path)
    assert (found.status, found.error, found.seed) == ("completed", None, 4)
    assert found.overrides == ["seed=4"]
    assert found.metrics == {"test/generated/accuracy": 0.5}
    assert 0 <= found.seconds["total"] <= time.perf_counter() - before + 0.001


@pytest.mark.parametrize(
    ("raised", "status", "error"),
    [
        (UserError("m is wrong"), "failed", "UserError: m is wrong"),
        (Interrupted("Resume it."), "interrupted", "Resume it."),
        (KeyboardInterrupt(), "interrupted", "interrupted"),
    ],
)
def test_recorded_exception_is_written_and_raised(raised, status, error, tmp_path):
    with pytest.raises(type(raised)), recorded(plain([]), tmp_path, []):
        raise raised
    found = run_record.read(tmp_path)
    assert (found.status, found.error) == (status, error)


def test_run_on_part_of_the_batches_says_so(tmp_path, capsys):
    limits = ["+trainer.limit_train_batches=1", "+trainer.limit_test_batches=1"]
    record = job(tmp_path / "run", "weights=null", *limits)
    parts = ["trained on 1 of 2 batches of an epoch", "tested on 1 of 3 batches"]
    assert record.partial == run_record.read(tmp_path / "run").partial == parts
    assert f" s, but {' and '.join(parts)}; files in " in capsys.readouterr().out
    record = job(tmp_path / "steps", "weights=null", "+trainer.max_steps=1", "trainer.max_epochs=3")
    assert record.partial == ["trained for 1 of 6 steps"]


def test_completed_run_resumed_is_completed_with_the_cpu_time_of_all_parts(tmp_path):
    first = job(tmp_path / "first", "weights=null")
    assert first.partial == []
    path = tmp_path / "first" / "checkpoints" / CHECKPOINT
    content = torch.load(path, weights_only=True)
    content["callbacks"]["CPUTime"]["seconds"] += 1000
    AtomicCheckpointIO().save_checkpoint(content, path)
    again = job(tmp_path / "again", "weights=null", f"ckpt_path={path}")
    assert (again.status, again.partial) == ("completed", [])
    assert again.metrics == first.metrics
    assert again.seconds["fit_cpu"] > 1000
