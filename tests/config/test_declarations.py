"""Tables of what settings declare, as help, resuming, evaluations and reports use it."""

import math
from typing import Any

import pytest

from mops_lightning.config import settings
from mops_lightning.config.compose import compose
from mops_lightning.config.declaration import Affects, InEvaluation, Training

PATHS = (*settings.declared(), *settings.INSIDE)

AFFECTS = {
    Affects.NOTHING: {
        "cache",
        "callbacks.checkpoint",
        "callbacks.learning_rate",
        "callbacks.pictures",
        "callbacks.progress",
        "ckpt_path",
        "dataset.cache",
        "epochs",
        "epochs.joint",
        "epochs.sampler",
        "epochs.task",
        "logger",
        "logger.flush_logs_every_n_steps",
        "names.stages",
        "out",
        "pictures",
        "tags",
        "task.net.sampler.m",
        "task.net.sampler.m_max",
        "trainer._target_",
        "trainer.accelerator",
        "trainer.default_root_dir",
        "trainer.detect_anomaly",
        "trainer.devices",
        "trainer.enable_checkpointing",
        "trainer.enable_model_summary",
        "trainer.enable_progress_bar",
        "trainer.log_every_n_steps",
        "trainer.num_nodes",
        "trainer.num_sanity_val_steps",
        "trainer.profiler",
        "trainer.strategy",
    },
    Affects.SCORES: {
        "baselines",
        "m",
        "names",
        "sampler.threshold",
        "sizes",
        "test_corruption",
        "test_noise_std",
        "trainer.barebones",
        "trainer.limit_test_batches",
    },
    Affects.RESULTS: {
        "batch_size",
        "dataset",
        "dataset.download",
        "evaluate",
        "pretrain",
        "pretrain.lr",
        "sampler",
        "sampler.m",
        "sampler.m_max",
        "sampler.seed",
        "seed",
        "task",
        "weights",
    },
}
"""The effect of settings; all others affect the training alone."""

COUNTS = {
    ("sampler",): {"other_nets"},
    ("joint",): {"task_lr_scale"},
    ("sampler", "joint"): {
        "recipe",
        "recipe.all_points_from",
        "recipe.ema_span",
        "recipe.train_points",
    },
    ("sampler", "joint", "nothing"): {
        "baselines",
        "pretrain",
        "pretrain.lr",
        "sampler",
        "sampler.m",
        "sampler.m_max",
        "sampler.seed",
        "sampler.threshold",
        "sizes",
    },
    (): {"task.net.sampler.m", "task.net.sampler.m_max"},
}
"""The values of learn with which settings count; all others count with all."""

SERVES = {
    Training.FIRST: {"pretrain", "pretrain.lr", "pretrain_from"},
    Training.SAMPLER: {"baselines", "other_nets", "recipe"},
    Training.FIRST | Training.TASK_NET: {"recipe.task_points"},
    Training.JOINT | Training.SAMPLER: {
        "recipe.all_points_from",
        "recipe.ema_span",
        "recipe.train_points",
    },
    Training.TASK_NET | Training.JOINT | Training.SAMPLER: {"optimizer", "optimizer.lr"},
}
"""The trainings of settings; all others belong to none alone."""

REPEATED = {
    "augment",
    "augment.sampler",
    "baselines",
    "batch_size",
    "dataset",
    "epochs",
    "epochs.joint",
    "epochs.sampler",
    "epochs.task",
    "m",
    "names",
    "names.stages",
    "other_nets",
    "pretrain",
    "pretrain.lr",
    "pretrain_from",
    "sampler",
    "sampler.m",
    "sampler.m_max",
    "sampler.seed",
    "sampler.threshold",
    "seed",
    "sizes",
    "task",
    "task.net.sampler.m",
    "task.net.sampler.m_max",
    "task_lr_scale",
    "test_corruption",
    "test_noise_std",
    "val_fraction",
}
"""Settings that an evaluation takes from its run."""

COMPARED = {
    "augment",
    "augment.sampler",
    "batch_size",
    "optimizer",
    "optimizer.lr",
    "sampler",
    "sampler.threshold",
    "task",
    "task_lr_scale",
    "test_corruption",
    "test_noise_std",
    "val_fraction",
}
"""Settings in which the runs of a table must not differ."""

IN_EVALUATION = {
    InEvaluation.STAYS: {
        "augment.sampler",
        "ckpt_path",
        "epochs.joint",
        "epochs.sampler",
        "learn",
        "optimizer",
        "optimizer.lr",
        "other_nets",
        "recipe",
        "recipe.all_points_from",
        "recipe.ema_span",
        "recipe.task_points",
        "recipe.train_points",
        "task.net.sampler.m",
        "task.net.sampler.m_max",
        "task_lr_scale",
        "trainer.max_epochs",
    },
    InEvaluation.FOR_NEW_NET: {
        "augment",
        "epochs",
        "epochs.task",
        "pretrain",
        "pretrain.lr",
        "pretrain_from",
        "trainer.accumulate_grad_batches",
        "trainer.gradient_clip_algorithm",
        "val_fraction",
    },
}
"""Whether an evaluation may change settings; all others it may."""

NULLABLE = {
    "ckpt_path",
    "evaluate",
    "logger",
    "logger.flush_logs_every_n_steps",
    "other_nets",
    "pretrain_from",
    "tags",
    "test_corruption",
    "weights",
}

BY_CONTENT = {"dataset", "dataset.cache", "dataset.download", "other_nets", "weights"}


def by_value(value_of, usual):
    """Return the paths by what is declared of them, without those of the usual value."""
    found: dict[object, set[str]] = {}
    for path in PATHS:
        value = value_of(settings.of(path))
        if value != usual:
            found.setdefault(value, set()).add(path)
    return found


def test_settings_affect_what_they_should():
    assert by_value(lambda setting: setting.affects, Affects.TRAINING) == AFFECTS


def test_settings_count_with_the_right_values_of_learn():
    assert by_value(lambda setting: setting.learn, None) == COUNTS


def test_settings_serve_the_right_trainings():
    assert by_value(lambda setting: setting.serves, None) == SERVES


def test_settings_may_change_in_an_evaluation_as_declared():
    found = by_value(lambda setting: setting.in_evaluation, InEvaluation.CHANGES)

    assert found == IN_EVALUATION


@pytest.mark.parametrize(
    ("flag", "expected"),
    [
        ("repeated", REPEATED),
        ("compared", COMPARED),
        ("nullable", NULLABLE),
        ("by_content", BY_CONTENT),
        ("per_learn", {"augment", "augment.sampler"}),
    ],
)
def test_flags_of_settings_are_set_where_they_should(flag, expected):
    assert by_value(lambda setting: getattr(setting, flag), False) == {True: expected}


INSIDE = {
    "recipe.distillation": "recipe",
    "recipe.train_pointsmore": "recipe",
    "sampler.m_maximum": "sampler",
    "task.net.sampler.mover": "task",
}
"""Settings that are not declared, and the group whose declaration they have."""


@pytest.mark.parametrize(("path", "group"), INSIDE.items())
def test_undeclared_setting_is_declared_by_its_group(path, group):
    assert settings.of(path) == settings.of(group)


LIMITS: dict[str, tuple[list[Any], list[Any]]] = {
    "m": ([1], [0, 1.0, None]),
    "sizes": (["auto", [1]], ["all", 8, [], [0], [8, 1.5]]),
    "learn": (["task", "sampler", "joint", "nothing"], ["both", None]),
    "seed": ([0], [-1, 0.5]),
    "other_nets": ([None, ["a"]], ["a", [1]]),
    "task_lr_scale": ([1e-9, 5], [0, -1, math.inf]),
    "batch_size": ([2], [1]),
    "val_fraction": ([0, 0.999], [1, -0.001]),
    "test_noise_std": ([0, 3], [-1e-9, math.nan]),
    "tags": ([None, ["a"]], ["a", [1]]),
    "pictures": ([0], [-1]),
    "optimizer.lr": ([1e-9], [0, "fast"]),
    "pretrain.lr": ([1e-9], [0]),
    "epochs.task": ([1], [0]),
    "epochs.sampler": ([0], [-1]),
    "epochs.joint": ([0], [-1]),
    "logger.flush_logs_every_n_steps": ([1], [0]),
    "trainer.max_epochs": ([-1, 0], [-2, 1.5]),
    "trainer.max_steps": ([-1, 1], [0, -2]),
    "trainer.max_time": ([None, "00:08:00:00", {"hours": 8}], ["", 5, "5", {}]),
    "trainer.strategy": (["auto", "ddp", None], ["ddp_spawn", "ddp_fork", "ddp_notebook"]),
    "trainer.gradient_clip_val": ([None, 0.1], [0, -1]),
    "trainer.accumulate_grad_batches": ([1], [0]),
    "trainer.log_every_n_steps": ([1], [0]),
    "trainer.deterministic": ([True, False, None, "warn"], ["no"]),
    "trainer.logger": ([], [True, None]),
    "trainer.callbacks": ([], [[]]),
}
"""Settings with limits, values at their ends, and the first values beyond."""


def test_table_of_limits_names_every_setting_with_limits():
    assert {path for path in PATHS if settings.of(path).limits} == set(LIMITS)


@pytest.mark.parametrize("path", LIMITS)
def test_limits_take_the_last_allowed_values_and_refuse_the_next(path):
    limits = settings.limits(path)
    allowed, refused = LIMITS[path]

    assert limits is not None
    for value in allowed:
        assert limits.fits(value), value
    for value in refused:
        assert not limits.fits(value), value


DEFAULTS = {
    "m": 32,
    "sizes": "auto",
    "learn": "sampler",
    "seed": 0,
    "weights": "auto",
    "pretrain_from": None,
    "other_nets": None,
    "ckpt_path": None,
    "evaluate": None,
    "task_lr_scale": 1.0,
    "batch_size": 32,
    "val_fraction": 0.05,
    "test_noise_std": 0.0,
    "test_corruption": None,
    "tags": None,
    "pictures": 4,
    "out": "outputs",
}


def test_run_level_settings_have_their_documented_defaults(monkeypatch):
    monkeypatch.delenv("MOPS_CACHE", raising=False)

    cfg = compose(["dataset=modelnet40"])

    assert {name: cfg[name] for name in DEFAULTS} == DEFAULTS
    assert cfg.cache == "~/.cache/mops_lightning"
