from typing import Any

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
