from typing import Any

from omegaconf import OmegaConf

from mops_lightning.config.compose import compose
from mops_lightning.config.shared_settings import table_settings, training_settings


def test_training_settings_count_what_the_run_learns():
    joint = training_settings(plain("learn=joint"))
    alone = training_settings(plain("learn=task"))
    assert {"task_lr_scale", "sampler.tau_min", "trainer.max_epochs", "learn"} <= set(joint)
    assert not [name for name in alone if name.startswith(("sampler", "task_lr", "pretrain."))]
    assert alone["augment.rotate_up"] is True
    assert not [name for name in joint if name.startswith("augment")]
    assert not {name for name in joint if name.startswith(("dataset", "weights", "out", "logger"))}


def plain(*overrides: str) -> Any:
    return OmegaConf.to_container(compose(list(overrides)), resolve=True)


def test_table_settings_of_an_old_record_takes_defaults():
    found = table_settings({"m": 8, "out": "here", "sampler": {"alpha": 1.0}}, "sampler")
    assert (found["sampler.alpha"], found["test_noise_std"]) == (1.0, 0.0)
    assert not {"m", "out", "task_lr_scale"} & set(found)


def test_table_settings_fill_in_defaults_of_constructors():
    new = plain("sampler=fmops", "task=registration", "task.net.iterations=1")
    old = plain("sampler=fmops", "task=registration", "task.net.iterations=1")
    for node, names in (
        (old["sampler"], ["overlap", "threshold", "feature_channels"]),
        (old["task"]["net"], ["iterations", "feature_channels"]),
        (old["optimizer"]["schedule"], ["warmup"]),
        (old["augment"], ["sampler"]),
    ):
        for name in names:
            del node[name]
    assert table_settings(old, "sampler") == table_settings(new, "sampler")
    old["sampler"]["_target_"] = "os.system"
    assert table_settings(old, "sampler") != table_settings(new, "sampler")
