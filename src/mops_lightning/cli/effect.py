"""Settings of a part that a run does not have: they are refused, because nothing follows them."""

from omegaconf import DictConfig

from mops_lightning.config import overrides, settings
from mops_lightning.config.build import build, takes
from mops_lightning.config.declaration import Training
from mops_lightning.errors import UserError


def check_effect(cfg: DictConfig, given: list[str]) -> None:
    """Refuse a single run's settings of a part that it does not have; a sweep's cells may differ.

    Args:
        cfg: the run's settings.
        given: the overrides that it was composed from.

    Raises:
        UserError: there is one.
    """
    for argument in given:
        reason = _lacks_part_of(overrides.path(argument), cfg)
        if reason:
            raise UserError(f"{argument}: has no effect {reason}. Leave it out.")


def _lacks_part_of(path: str, cfg: DictConfig) -> str:
    """Return why a run lacks the part that a setting belongs to; empty if it has it."""
    setting = settings.of(path)
    is_choice = path in settings.declared() and setting.group
    if is_choice:  # it may change settings of other groups
        return ""
    if setting.learn == ():
        return "beside task.net.points"
    if not setting.counts(cfg.learn):
        return f"with learn={cfg.learn}"
    if setting.serves is None or _has_one_of(setting.serves, cfg):
        return ""
    if Training.FIRST in setting.serves:
        return f"with weights={cfg.weights or 'null'}"
    return f"with sampler={cfg.names.sampler}, which is not trained"


def _has_one_of(trainings: Training, cfg: DictConfig) -> bool:
    """Return whether a run has one of these trainings."""
    if Training.FIRST in trainings and cfg.weights == "auto":
        return True
    if Training.TASK_NET in trainings and cfg.learn == "task":
        return True
    if Training.JOINT in trainings and cfg.learn == "joint":
        return True
    if Training.SAMPLER in trainings and cfg.learn != "task":
        return _sampler_is_learned(cfg.sampler)
    return False


def _sampler_is_learned(node: DictConfig) -> bool:
    """Return whether a sampler has weights; one that is given the task net has its own losses."""
    from hydra.utils import get_object

    from mops_lightning.samplers.base import Sampler  # imports torch

    if takes(node, "net"):
        return get_object(node._target_).losses is not Sampler.losses
    return bool(getattr(build(node, "sampler"), "learned", True))
