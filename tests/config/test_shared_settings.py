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
    assert joint["augment.rotate_up"] is False
    assert not {name for name in joint if name.startswith(("dataset", "weights", "out", "logger"))}


def plain(*overrides: str) -> Any:
    return OmegaConf.to_container(compose(list(overrides)), resolve=True)


def test_table_settings_leave_out_what_reports_do_not_compare():
    found = table_settings({"m": 8, "out": "here", "sampler": {"alpha": 1.0}}, "sampler")
    assert found == {"sampler.alpha": 1.0}
