"""Ending a run whose loss or weights are no longer finite."""

from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.strategies import Strategy
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.zoo.weights import first_nonfinite

HINT = "Try a lower learning rate (optimizer.lr) or other weights of the losses."

SAVED = ("state_dict", "current_model_state", "optimizer_states")
"""Parts of a checkpoint that hold tensors of the training; the second is of a moving average."""


class Diverged(UserError):
    """The loss or the weights contain NaN or infinity."""


def check_loss(total: Tensor, step: int, strategy: Strategy) -> None:
    """End training, on all processes of a run, if the loss of one is not finite.

    Args:
        total: the loss, a scalar.
        step: number of optimizer steps so far.
        strategy: Lightning's; reaches the other processes.

    Raises:
        Diverged: it is not finite.
    """
    loss = total.detach()
    bad = not bool(torch.isfinite(loss))
    if strategy.reduce_boolean_decision(bad, all=False):
        raise Diverged(f"training diverged: the loss is {float(loss)} after {step} steps.")


def check_checkpoint(checkpoint: dict[str, Any], strategy: Strategy) -> None:
    """Refuse to save a state that is not finite, which would replace the last good checkpoint.

    Args:
        checkpoint: as Lightning makes it.
        strategy: Lightning's; reaches the other processes.

    Raises:
        Diverged: weights or the optimizer's state contain NaN or infinity.
    """
    parts = {key: checkpoint.get(key) for key in SAVED}
    name = first_nonfinite(parts)
    if strategy.reduce_boolean_decision(name is not None, all=False):
        raise Diverged(f"training diverged: {name or 'a tensor'} is not finite.")


def with_checkpoint(error: UserError, checkpoint: Path | None) -> UserError:
    """Add the last finite checkpoint, if any, and what to try to the error of a diverged run."""
    kept = f" The last finite checkpoint is {checkpoint}." if checkpoint else ""
    return UserError(f"{error} No weights were saved.{kept} {HINT}")
