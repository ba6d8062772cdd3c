"""Functions that make an optimizer and its schedule, tried before anything is trained."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from mops_lightning.config.build import build


@dataclass(frozen=True)
class OptimizerMakers:
    """Functions that make the optimizer and the schedule that a node of settings describes.

    Attributes:
        optimizer: makes an optimizer from parameters or groups of parameters.
        schedule: makes a schedule from ``(optimizer, total_steps)``; None: the rate is constant.
    """

    optimizer: Callable[..., Optimizer]
    schedule: Callable[..., LRScheduler] | None

    @classmethod
    def of(cls, node: DictConfig, where: str) -> "OptimizerMakers":
        """Return the makers that a node describes.

        Args:
            node: an optimizer's class and arguments, with those of its schedule in ``schedule``.
            where: the node's place in the configuration, for errors.
        """
        arguments: Any = OmegaConf.to_container(node, resolve=True)
        schedule_arguments = arguments.pop("schedule", None)
        schedule = None
        optimizer = _maker(arguments, where)
        if schedule_arguments:
            schedule = _maker(schedule_arguments, f"{where}.schedule")
        return cls(optimizer, schedule)

    def check(self) -> None:
        """Make an optimizer of one parameter, so that mistakes end the run before any training.

        Raises:
            UserError: an argument is wrong.
        """
        parameter = torch.nn.Parameter(torch.zeros(1))
        optimizer = self.optimizer([parameter])
        if self.schedule is not None:
            self.schedule(optimizer, total_steps=2)


def _maker(arguments: dict[str, Any], where: str) -> Callable[..., Any]:
    node = OmegaConf.create({**arguments, "_partial_": True})
    maker: Callable[..., Any] = build(node, where)
    return maker


def check_optimizers(cfg: DictConfig) -> None:
    """Check the optimizers of a run, also the task net's if its weights are cached.

    Raises:
        UserError: an argument of ``optimizer`` or ``pretrain`` is wrong.
    """
    if cfg.learn != "nothing":
        OptimizerMakers.of(cfg.optimizer, "optimizer").check()
    if cfg.learn != "task" and cfg.weights == "auto":
        OptimizerMakers.of(cfg.pretrain, "pretrain").check()
