import math
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.records import run_record
from mops_lightning.training.checkpoint import CHECKPOINT, Diverged
from mops_lightning.training.run.checkpoint_io import AtomicCheckpointIO
from mops_lightning.training.run.recorded import recorded
from mops_lightning.training.run.run import run
from mops_lightning.training.run.stages import _check_scores
from tests.support.command_line import TINY_ANY_DATA, job
from tests.support.hdf5 import write_file


def plain(overrides: list[str]) -> Any:
    return OmegaConf.to_container(compose(overrides), resolve=True)


def test_recorded_running_then_completed(tmp_path):
    config = plain(["seed=4"])
    before = time.perf_counter()

    with recorded(config, tmp_path, ["seed=4"]) as record:
        begun = run_record.read(tmp_path)
        record.metrics["test/generated/accuracy"] = 0.5

    assert begun.status == "running"
    found = run_record.read(tmp_path)
    passed = time.perf_counter() - before
    assert found.status == "completed"
    assert found.error is None
    assert found.seed == 4
    assert found.overrides == ["seed=4"]
    assert found.metrics == {"test/generated/accuracy": 0.5}
    assert 0 <= found.seconds["total"] <= passed + 0.001


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

    of_training = "trained on 1 of 2 batches of an epoch"
    of_test = "tested on 1 of 3 batches"
    assert record.partial == [of_training, of_test]
    assert run_record.read(tmp_path / "run").partial == [of_training, of_test]
    assert f" s, but {of_training} and {of_test}; files in " in capsys.readouterr().out

    steps = ["+trainer.max_steps=1", "trainer.max_epochs=3"]
    record = job(tmp_path / "steps", "weights=null", *steps)

    assert record.partial == ["trained for 1 of 6 steps"]


def test_completed_run_resumed_is_completed_with_the_cpu_time_of_all_parts(tmp_path):
    first = job(tmp_path / "first", "weights=null")
    assert first.partial == []
    path = tmp_path / "first" / "checkpoints" / CHECKPOINT
    content = torch.load(path, weights_only=True)
    content["callbacks"]["CPUTime"]["seconds"] += 1000
    AtomicCheckpointIO().save_checkpoint(content, path)

    again = job(tmp_path / "again", "weights=null", f"ckpt_path={path}")

    assert again.status == "completed"
    assert again.partial == []
    assert again.metrics == first.metrics
    assert again.seconds["fit_cpu"] > 1000


def test_resumed_run_records_what_its_training_began_with(tmp_path):
    job(tmp_path / "net", "learn=task", "+trainer.limit_train_batches=1")
    net = f"weights={tmp_path / 'net'}"
    first = job(tmp_path / "first", net)
    path = tmp_path / "first" / "checkpoints" / CHECKPOINT

    again = job(tmp_path / "again", net, f"ckpt_path={path}", "trainer.max_epochs=2")
    path = tmp_path / "again" / "checkpoints" / CHECKPOINT
    third = job(tmp_path / "third", net, f"ckpt_path={path}", "trainer.max_epochs=3")

    assert first.weights_loaded
    assert first.warm_start
    assert first.partial == ["used a task net trained with trainer.limit_train_batches=1"]
    for resumed in (again, third):
        assert resumed.weights_loaded == first.weights_loaded
        assert resumed.warm_start == first.warm_start
        assert resumed.partial == first.partial


@pytest.mark.parametrize(
    ("limits", "partial"),
    [
        ([], []),
        (["+trainer.max_steps=3"], ["trained for 3 of 4 steps"]),
    ],
)
def test_steps_of_accumulated_gradients_are_counted_with_the_last_of_an_epoch(
    limits, partial, tmp_path
):
    """Of three batches, two and one make a step."""
    accumulated = ["+trainer.accumulate_grad_batches=2", "val_fraction=0", "trainer.max_epochs=2"]

    record = job(tmp_path / "run", "weights=null", "recipe=paper", *accumulated, *limits)

    assert record.partial == partial


def test_run_on_clouds_far_from_the_unit_sphere_says_so(tmp_path, capsys):
    for split in ("train", "test"):
        points = np.random.default_rng(0).normal(size=(4, 64, 3)).astype(np.float32)
        write_file(tmp_path / f"{split}.h5", data=1000 * points, label=np.arange(4) % 2)
    given = ["dataset=hdf5", f"dataset.root={tmp_path}", "sampler=fps", "weights=null"]
    settings = [*TINY_ANY_DATA, *given, f"cache={tmp_path}/cache"]

    run(compose(settings), tmp_path / "run", settings)

    assert "from the origin, but nets and samplers are made for the unit" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["test/generated/accuracy", "test/loss/cross_entropy"])
def test_score_or_loss_that_is_not_finite_ends_a_test_of_given_nets(name):
    parts: Any = SimpleNamespace(
        trains=False, experiment=SimpleNamespace(score_name="test/generated/accuracy")
    )
    others = {"test/matched/accuracy": math.nan, "test/loss/cross_entropy": 1.0}
    others["latency"] = math.nan  # of a callback

    _check_scores(parts, others)
    with pytest.raises(UserError, match=rf"{name} is nan\. Check the data and the weights\."):
        _check_scores(parts, {**others, name: math.nan})
    parts.trains = True
    with pytest.raises(Diverged, match=f"training diverged: {name} is inf"):
        _check_scores(parts, {**others, name: math.inf})
