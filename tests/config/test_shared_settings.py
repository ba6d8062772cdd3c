from typing import Any

import pytest
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose
from mops_lightning.config.shared_settings import table_settings, training_settings


def test_training_settings_count_what_the_run_learns():
    joint = training_settings(plain("learn=joint"))
    alone = training_settings(plain("learn=task"))

    assert {"task_lr_scale", "sampler.tau_min", "trainer.max_epochs", "learn"} <= set(joint)
    assert alone["augment.rotate_up"] is True
    assert not begin_with(alone, "sampler", "task_lr", "pretrain.")
    assert not begin_with(joint, "augment", "dataset", "weights", "out", "logger")


OF_TRAINING = {
    "batch_size",
    "evaluate",
    "learn",
    "optimizer",
    "pretrain_from",
    "recipe",
    "seed",
    "task",
    "trainer",
    "val_fraction",
}
"""Settings and groups that affect every training, without those that are compared by content."""

OF_TABLES = {
    "augment",
    "batch_size",
    "optimizer",
    "task",
    "test_corruption",
    "test_noise_std",
    "val_fraction",
}
"""Settings and groups in which the runs of one table must not differ."""


@pytest.mark.parametrize(
    ("learn", "of_training", "of_tables"),
    [
        ("sampler", {"pretrain", "sampler"}, {"sampler"}),
        ("joint", {"pretrain", "sampler", "task_lr_scale"}, {"sampler", "task_lr_scale"}),
        ("task", {"augment"}, set()),
    ],
)
def test_settings_of_a_training_and_of_a_table_are_these(learn, of_training, of_tables):
    config = plain(f"learn={learn}")

    assert groups_of(training_settings(config)) == OF_TRAINING | of_training
    assert groups_of(table_settings(config, learn)) == OF_TABLES | of_tables


def groups_of(settings: dict[str, Any]) -> set[str]:
    """Return the settings of the top level to which dotted settings belong."""
    return {path.partition(".")[0] for path in settings}


def begin_with(settings: dict[str, Any], *starts: str) -> list[str]:
    return [name for name in settings if name.startswith(starts)]


def plain(*overrides: str) -> Any:
    return OmegaConf.to_container(compose(list(overrides)), resolve=True)


def test_table_settings_of_an_old_record_takes_defaults():
    config = {"m": 8, "out": "here", "sampler": {"alpha": 1.0}}

    settings = table_settings(config, "sampler")

    assert settings["sampler.alpha"] == 1.0
    assert settings["test_noise_std"] == 0.0
    assert not {"m", "out", "task_lr_scale"} & set(settings)


def test_table_settings_fill_in_defaults_of_constructors():
    new = plain("sampler=fmops", "task=registration", "task.net.iterations=1")
    old = plain("sampler=fmops", "task=registration", "task.net.iterations=1")
    for name in ("overlap", "threshold", "feature_channels"):
        del old["sampler"][name]
    for name in ("iterations", "feature_channels"):
        del old["task"]["net"][name]
    del old["optimizer"]["schedule"]["warmup"]
    del old["augment"]["sampler"]

    assert table_settings(old, "sampler") == table_settings(new, "sampler")

    old["sampler"]["_target_"] = "os.system"

    assert table_settings(old, "sampler") != table_settings(new, "sampler")
