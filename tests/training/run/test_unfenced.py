"""Arguments of Lightning's trainer do what Lightning documents, through the real command line."""

import copy
import csv
import re

import pytest
import torch
from torch import nn

from mops_lightning.config.compose import compose
from mops_lightning.config.shortened import shortening
from mops_lightning.errors import UserError
from mops_lightning.nets.max_pool import PointMaxPool
from mops_lightning.records import run_record
from mops_lightning.report.collect import collect
from mops_lightning.training.experiment import Experiment
from mops_lightning.zoo import weights
from tests.support.command_line import TINY, call, done, job, refused

LONG = [one for one in TINY if "epochs" not in one]
"""The smallest job with the numbers of epochs of a whole one."""


def trained_rows(monkeypatch):
    """Collect the rows of the training clouds that each step sees."""
    seen = []
    step = Experiment.training_step

    def noting(self, batch, number):
        seen.append(batch.rows.tolist())
        return step(self, batch, number)

    monkeypatch.setattr(Experiment, "training_step", noting)
    return seen


def test_fast_dev_run_tries_one_batch_of_everything_and_saves_no_checkpoint(tmp_path, monkeypatch):
    seen = trained_rows(monkeypatch)
    arguments = [*LONG, "logger=tensorboard", "val_fraction=0.25", "+trainer.fast_dev_run=true"]

    out = done([*arguments, "hydra.run.dir=run"], tmp_path)

    assert len(seen) == 2  # one step of the task net, one of the sampler
    record = run_record.read(tmp_path / "run")
    assert record.partial == [
        "used a task net trained with trainer.fast_dev_run=True",
        "tried with trainer.fast_dev_run=True",
        "trained on 1 of 2 batches of an epoch",
        "trained for 1 of 10 steps",
        "tested on 1 of 3 batches",
    ]
    assert "but used a task net trained with trainer.fast_dev_run=True" in out
    assert not list(tmp_path.rglob("*.ckpt"))
    assert not list(tmp_path.rglob("events.out*"))
    assert not list((tmp_path / "cache").rglob(weights.FILE))


def test_debug_fdr_is_fast_dev_run():
    assert compose(["debug=fdr"]).trainer.fast_dev_run is True


def test_overfit_batches_trains_on_the_same_batches_in_every_epoch(tmp_path, monkeypatch):
    seen = trained_rows(monkeypatch)
    settings = ["weights=null", "val_fraction=0", "trainer.max_epochs=3"]

    record = job(tmp_path / "run", *settings, "+trainer.overfit_batches=2")

    first = [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert seen == first * 3
    assert record.partial == [
        "tried with trainer.overfit_batches=2",
        "trained on 2 of 3 batches of an epoch",
    ]


def test_debug_overfit_lowers_the_loss_of_its_batches(tmp_path):
    out = done([*TINY, "debug=overfit", "weights=null", "trainer.max_epochs=8"], tmp_path)

    losses = [float(line.rpartition(" ")[2]) for line in out.splitlines() if "mean_loss" in line]
    assert len(losses) == 8
    assert losses[-1] < 0.9 * losses[0]


def test_profiler_simple_is_shown_and_saved(tmp_path):
    out = done([*TINY, "debug=profiler", "weights=null", "hydra.run.dir=run"], tmp_path)

    assert "FIT Profiler Report" in out
    assert "run_training_batch" in out
    assert "TEST Profiler Report" in out
    record = run_record.read(tmp_path / "run")
    for kind, name in (("profile_fit", "fit-profile.txt"), ("profile_test", "test-profile.txt")):
        assert record.files[kind] == name
        assert "Profiler Report" in (tmp_path / "run" / name).read_text()


def test_limits_of_zero_train_and_test_nothing(tmp_path, capsys):
    limits = ["+trainer.limit_train_batches=0", "+trainer.limit_test_batches=0"]

    record = job(tmp_path / "run", "weights=null", *limits)

    assert record.partial == [
        "trained on 0 of 2 batches of an epoch",
        "tested on 0 of 3 batches",
    ]
    assert (record.score, record.metrics) == (None, {})
    assert "but trained on 0 of 2 batches of an epoch" in capsys.readouterr().out


def test_barebones_trains_and_is_marked_as_a_run_without_scores(tmp_path):
    plain = job(tmp_path / "plain", "weights=null")

    record = job(tmp_path / "bare", "weights=null", "+trainer.barebones=true")

    assert record.partial == ["tested on all clouds without scores (trainer.barebones)"]
    assert (record.score, record.metrics) == (None, {})
    trained, same = (weights.read(tmp_path / run / weights.FILE) for run in ("plain", "bare"))
    assert trained["sha256"] == same["sha256"]
    assert plain.partial == []


def test_switches_of_display_and_checks_work_and_change_no_result(tmp_path):
    switches = [
        "+trainer.enable_progress_bar=false",
        "+trainer.enable_checkpointing=false",
        "+trainer.enable_model_summary=true",
        "+trainer.num_sanity_val_steps=1",
        "+trainer.detect_anomaly=true",
        "+trainer.log_every_n_steps=1",
        "+trainer.strategy=auto",
        "val_fraction=0.25",
    ]
    plain = job(tmp_path / "plain", "weights=null", "val_fraction=0.25")

    record = job(tmp_path / "switched", "weights=null", *switches)

    assert record.metrics == plain.metrics
    assert (record.partial, plain.partial) == ([], [])
    assert not (tmp_path / "switched" / "checkpoints").exists()


def test_plugin_is_used_and_one_that_writes_checkpoints_is_refused(tmp_path):
    plugins = "lightning.pytorch.plugins"
    double = f"+trainer.plugins._target_={plugins}.precision.DoublePrecision"
    io = f"+trainer.plugins=[{{_target_: {plugins}.io.AsyncCheckpointIO}}]"

    job(tmp_path / "double", "weights=null", double, "trainer.precision=null")

    state = weights.read(tmp_path / "double" / weights.FILE)["state"]
    assert state["queries.weight"].dtype == torch.float64
    with pytest.raises(UserError, match="plugins: AsyncCheckpointIO cannot be used"):
        job(tmp_path / "io", "weights=null", io)


@pytest.mark.parametrize(
    ("given", "logged_steps"),
    [
        (["+trainer.log_every_n_steps=3"], ["2", "5"]),
        ([], ["1", "3", "5", "7"]),  # once in an epoch of two steps
    ],
    ids=["given", "short epochs"],
)
def test_log_every_n_steps_gives_one_point_for_so_many_steps(given, logged_steps, tmp_path):
    settings = ["weights=null", "logger=csv", "trainer.max_epochs=4"]

    job(tmp_path / "run", *settings, *given)

    (path,) = (tmp_path / "run").rglob("metrics.csv")
    with path.open() as file:
        rows = list(csv.DictReader(file))
    steps = [row["step"] for row in rows if row["train/tau"]]
    assert steps == logged_steps  # of 8


def test_true_bfloat16_trains_and_tests(tmp_path):
    record = job(tmp_path / "run", "weights=null", "trainer.precision=bf16-true")

    state = weights.read(tmp_path / "run" / weights.FILE)["state"]
    assert {value.dtype for value in state.values() if value.is_floating_point()} == {
        torch.bfloat16
    }
    assert 0 <= record.score <= 1


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("trainer.precision=bf17", "trainer.*bf17"),
        ("+trainer.limit_train_batches=1.5", "trainer.*limit_train_batches"),
        ("+trainer.profiler=slow", "trainer.*profiler.*simple"),
        ("+trainer.strategy=nope", "trainer.*nope"),
        ("+trainer.check_val_every_n_epoch=1.5", "check_val_every_n_epoch"),
    ],
)
def test_refusals_of_lightning_reach_the_user_in_one_line(argument, said, tmp_path):
    err = refused([*TINY, "weights=null", argument], tmp_path)
    assert re.search(said, err)


def test_shortened_task_net_starts_no_sampler_and_fills_no_cache(tmp_path):
    job(tmp_path / "short", "learn=task", "+trainer.limit_train_batches=1")

    assert not list((tmp_path / "cache").rglob(weights.FILE))
    assert shortening(run_record.read(tmp_path / "short").config) == [
        "trainer.limit_train_batches=1"
    ]

    record = job(tmp_path / "whole", f"weights={tmp_path}/short")

    assert record.partial == ["used a task net trained with trainer.limit_train_batches=1"]


def test_shortened_training_of_a_sampler_uses_the_cached_task_net(tmp_path):
    whole = job(tmp_path / "whole", "sampler=fps")

    short = job(tmp_path / "short", "+trainer.limit_train_batches=1")

    assert short.partial == ["trained on 1 of 2 batches of an epoch"]
    assert short.task_weights_sha256 == whole.task_weights_sha256


def test_shortened_sampler_is_no_warm_start_and_no_figure_of_a_report(tmp_path):
    job(tmp_path / "short", "weights=null", "+trainer.max_steps=1")
    start = f"recipe.warm_start={tmp_path}/short/{weights.FILE}"
    with pytest.raises(UserError, match=r"short/weights.* was trained with trainer\.max_steps=1"):
        job(tmp_path / "new", "weights=null", start)

    arguments = ["evaluate=short", "pictures=0", "logger=none", "hydra.run.dir=again"]

    done(arguments, tmp_path)

    again = run_record.read(tmp_path / "again").partial
    assert again == ["tested short, which was trained for 1 of 2 steps"]
    job(tmp_path / "full", "weights=null")
    found = collect(tmp_path)
    assert [record.folder for record in found.done] == [str(tmp_path / "full")]
    assert "trained for 1 of 2 steps" in found.undone[str(tmp_path / "short")]


def test_evaluation_of_a_run_that_was_tested_in_part_is_whole(tmp_path):
    job(tmp_path / "run", "weights=null", "+trainer.limit_test_batches=1")
    assert run_record.read(tmp_path / "run").partial == ["tested on 1 of 3 batches"]

    done(["evaluate=run", "pictures=0", "logger=none", "hydra.run.dir=again"], tmp_path)

    assert run_record.read(tmp_path / "again").partial == []
    assert [record.folder for record in collect(tmp_path).done] == [str(tmp_path / "again")]


def test_number_of_steps_in_place_of_epochs_is_a_whole_training(tmp_path, capsys):
    endless = ["trainer.max_epochs=-1", "+trainer.max_steps=5"]

    record = job(tmp_path / "run", *endless)

    assert record.partial == []
    assert "epoch 3  train/mean_loss" in capsys.readouterr().out  # two steps each
    assert list((tmp_path / "cache").rglob(weights.FILE))  # of a whole training of the task net
    again = job(tmp_path / "again", *endless, f"ckpt_path={tmp_path}/run")
    assert again.metrics == record.metrics


def test_limit_before_early_stopping_is_marked_and_early_stopping_is_not(tmp_path):
    stops = [
        "+callbacks.stop._target_=lightning.pytorch.callbacks.EarlyStopping",
        "+callbacks.stop.monitor=train/mean_loss",
        "+callbacks.stop.patience=1",
        "weights=null",
        "trainer.max_epochs=6",
    ]
    at_once = "+callbacks.stop.stopping_threshold=1e9"

    limited = job(tmp_path / "limited", *stops, "+trainer.max_steps=1")
    stopped = job(tmp_path / "stopped", *stops, at_once)

    assert limited.partial == ["trained for 1 of 12 steps"]
    assert stopped.partial == []
    assert stopped.seconds["fit"] > 0


@pytest.mark.parametrize(
    ("trainer", "reasons"),
    [
        ({"limit_train_batches": 1.0, "max_steps": -1, "fast_dev_run": False}, []),
        ({"max_epochs": -1, "max_steps": 9}, []),
        ({"max_epochs": 4, "max_steps": 9}, ["trainer.max_steps=9"]),
        ({"limit_train_batches": 1}, ["trainer.limit_train_batches=1"]),
        ({"limit_train_batches": 0.5}, ["trainer.limit_train_batches=0.5"]),
        ({"fast_dev_run": 2, "max_time": "00:00:00:01"}, 2),
        ({"limit_test_batches": 1, "limit_val_batches": 0}, []),
    ],
)
def test_shortening_names_what_shortens_a_training(trainer, reasons):
    found = shortening({"trainer": trainer})
    assert found == reasons or len(found) == reasons


def test_synchronised_batchnorm_takes_the_plain_layers():
    """Its statistics over all processes need the layer itself; the fused form has its own."""
    pool = PointMaxPool(8, 16)
    features = torch.randn(2, 64, 8)
    plain = copy.deepcopy(pool).values(features).amax(1)
    assert not torch.equal(copy.deepcopy(pool)(features), plain)  # other roundings

    converted = nn.SyncBatchNorm.convert_sync_batchnorm(pool)

    assert torch.equal(converted(features), plain)


def test_tags_are_recorded_and_change_nothing(tmp_path):
    record = job(tmp_path / "run", "weights=null", "sampler=fps", "tags=[first,wide]")
    assert record.config["tags"] == ["first", "wide"]
    status, _, _ = call([*TINY, "weights=null", "tags=first", "hydra.run.dir=no"], tmp_path)
    assert status == 2
