"""What an experiment may train."""

from typing import Literal, get_args

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.samplers.base import Sampler
from mops_lightning.tasks.base import Task

Learn = Literal["task", "sampler", "joint", "nothing"]
"""``joint`` trains task net and sampler."""


def check_learn(learn: Learn, task: Task, sampler: Sampler | None) -> None:
    """Reject what cannot be trained.

    Raises:
        UserError: ``learn`` is unknown, the sampler that it needs is missing, or the task net lets
            no gradient through.
    """
    allowed = get_args(Learn)
    if learn not in allowed:
        raise UserError(f"learn: unknown value {learn!r}.{did_you_mean(learn, allowed)}")
    if sampler is None and learn != "task":
        raise UserError(f"learn={learn} needs a sampler; only learn=task works without one.")
    learned = sampler is not None and sampler.learned
    learns = learn in ("task", "joint") or (learn == "sampler" and learned)
    if learns and not getattr(task.net, "differentiable", True):
        raise UserError(
            f"learn={learn}: {type(task.net).__name__} has no weights and lets no gradient "
            "through. Train under another task/net and test with evaluate=RUN, or choose a "
            "sampler that needs no training, such as sampler=fps."
        )
