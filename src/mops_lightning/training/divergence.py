"""Ending a run whose losses, weights or scores are no longer finite."""

from typing import Any

from lightning.pytorch.strategies import Strategy

from mops_lightning.errors import UserError
from mops_lightning.zoo.weights import first_nonfinite

SAVED = ("state_dict", "current_model_state", "optimizer_states")
"""Parts of a checkpoint that hold tensors of the training; the second is of a moving average."""


class Diverged(UserError):
    """A loss, a weight or a score is NaN or infinite."""


def check_finite(values: dict[str, Any], steps: int, strategy: Strategy) -> None:
    """End training, on all processes of a run, if a value of one is not finite.

    Args:
        values: tensors by name, nested as in a checkpoint.
        steps: number of optimizer steps so far.
        strategy: Lightning's; reaches the other processes.

    Raises:
        Diverged: a value is NaN or infinite.
    """
    name = first_nonfinite(values)
    if strategy.reduce_boolean_decision(name is not None, all=False):
        raise Diverged(f"training diverged: {name or 'a value'} is not finite at step {steps}.")
