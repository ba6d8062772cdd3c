"""Muon for the hidden matrices of a net, Adam for everything else, as one optimizer."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam, Muon, Optimizer


class MuonAdam(Optimizer):
    """Muon (Jordan et al., 2024) for weight matrices, Adam for biases, norms and small matrices.

    Muon's steps are scaled to the size of Adam's (Liu et al., 2025), so that one learning rate
    serves both.

    Args:
        params: parameters or groups of parameters.
        lr: learning rate of both.
        momentum: of Muon.
        betas: of Adam.
        smallest: fewest rows and columns of a matrix that Muon updates. Smaller ones, such as the
            layer that reads coordinates, have too few directions to balance.
    """

    def __init__(
        self,
        params: Iterable[Tensor] | Iterable[dict[str, Any]],
        lr: float = 1e-3,
        momentum: float = 0.95,
        betas: tuple[float, float] = (0.9, 0.999),
        smallest: int = 32,
    ) -> None:
        super().__init__(params, {"lr": lr})
        matrices: list[dict[str, Any]] = []
        others: list[dict[str, Any]] = []
        for group in self.param_groups:
            wide = [p for p in group["params"] if p.ndim == 2 and min(p.shape) >= smallest]
            known = {id(p) for p in wide}
            matrices.append({"params": wide})
            others.append({"params": [p for p in group["params"] if id(p) not in known]})
        muon = Muon(
            matrices, lr=lr, momentum=momentum, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"
        )
        self.parts: tuple[Optimizer, ...] = (muon, Adam(others, lr=lr, betas=betas))

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Update all parameters once; returns the value of ``closure``."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for part in self.parts:
            part.state = self.state  # the one that is saved in checkpoints, and restored
            for own, group in zip(part.param_groups, self.param_groups, strict=True):
                own["lr"] = group["lr"]
            part.step()
        return loss
