"""Settings of a part that a run does not have: they are refused, because nothing follows them."""

from functools import cached_property

from omegaconf import DictConfig

from mops_lightning.config import overrides, settings
from mops_lightning.config.build import accepted, build
from mops_lightning.errors import UserError

OF_PRETRAINING = ("pretrain.", "pretrain_from")
"""Settings of the training of a task net by ``weights=auto``."""

OF_SAMPLER_TRAINING = ("recipe.", "optimizer.", "baselines.", "other_nets")
"""Settings of the training of a sampler, and of what a trained one is compared with."""

ALSO_OF_TASK_NETS = (
    "optimizer.",
    *(f"recipe.{name}" for name in settings.RECIPE_OF_TASK_NETS),
)
"""Those that also serve a task net which is trained on the points of an index sampler."""

ALWAYS = ("recipe.task_points",)
"""Settings of a recipe that serve the pretraining, too."""


def check_effect(cfg: DictConfig, given: list[str]) -> None:
    """Refuse a single run's settings of a part that it does not have; a sweep's cells may differ.

    Args:
        cfg: the run's settings.
        given: the overrides that it was composed from.

    Raises:
        UserError: there is one.
    """
    run = _Run(cfg)
    for argument in given:
        if reason := run.lacks_part_of(overrides.path(argument)):
            raise UserError(f"{argument}: has no effect {reason}. Leave it out.")


class _Run:
    """The parts of a run, as its settings describe them.

    Args:
        cfg: the run's settings.
    """

    def __init__(self, cfg: DictConfig) -> None:
        self.cfg = cfg

    def lacks_part_of(self, path: str) -> str:
        """Return why the run lacks the part that a setting belongs to; empty if it has it."""
        setting = settings.of(path)
        is_choice = path in settings.declared() and setting.group
        if is_choice:  # it may change settings of other groups
            return ""
        if setting.learn == ():
            return "beside task.net.points"
        if not setting.counts(self.cfg.learn):
            return f"with learn={self.cfg.learn}"
        if path.startswith(OF_PRETRAINING) and self.cfg.weights != "auto":
            return f"with weights={self.cfg.weights or 'null'}"
        if path.startswith(OF_SAMPLER_TRAINING) and not self._trains_with(path):
            return f"with sampler={self.cfg.names.sampler}, which is not trained"
        return ""

    def _trains_with(self, path: str) -> bool:
        """Return whether this run trains something that a setting of a training serves."""
        if path in ALWAYS or self.cfg.learn == "task":
            return True
        if self.cfg.learn == "joint" and path.startswith(ALSO_OF_TASK_NETS):
            return True
        return self._sampler_is_trained

    @cached_property
    def _sampler_is_trained(self) -> bool:
        """Whether the sampler has weights; one that is given the task net has its own losses."""
        from hydra.utils import get_object

        from mops_lightning.samplers.base import Sampler  # imports torch

        node = self.cfg.sampler
        if accepted(node, {"net": None}):
            return get_object(node._target_).losses is not Sampler.losses
        return bool(getattr(build(node, "sampler"), "learned", True))
