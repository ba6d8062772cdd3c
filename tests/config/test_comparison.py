from typing import Any

from omegaconf import OmegaConf

from mops_lightning.config.comparison import compared_by, trained_with
from mops_lightning.config.compose import compose


def test_trained_with_counts_what_the_run_learns():
    joint = trained_with(plain("learn=joint"))
    alone = trained_with(plain("learn=task"))
    assert {"task_lr_scale", "sampler.tau_min", "trainer.max_epochs", "learn"} <= set(joint)
    assert not {name for name in alone if name.startswith(("sampler", "task_lr_scale", "pretrain"))}
    assert alone["augment.rotate_up"] is True
    assert joint["augment.rotate_up"] is False
    assert not {name for name in joint if name.startswith(("dataset", "weights", "out", "logger"))}


def plain(*overrides: str) -> Any:
    return OmegaConf.to_container(compose(list(overrides)), resolve=True)


def test_compared_by_of_an_old_record_takes_defaults():
    found = compared_by({"m": 8, "out": "here", "sampler": {"alpha": 1.0}}, "sampler")
    assert (found["sampler.alpha"], found["test_noise_std"]) == (1.0, 0.0)
    assert not {"m", "out", "task_lr_scale"} & set(found)
