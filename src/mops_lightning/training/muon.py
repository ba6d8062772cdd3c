"""Muon for the hidden matrices of a net, Adam for everything else, as one optimizer."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam, Optimizer

NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)
"""Coefficients of Jordan's iteration: steepest at 0, singular values end between 0.7 and 1.2."""
ITERATIONS = 5
RMS = 0.2
"""Root mean square of the entries of Adam's steps, which those of Muon get (Liu et al., 2025)."""


class MuonAdam(Optimizer):
    """Muon (Jordan et al., 2024) for weight matrices, Adam for biases, norms and small matrices.

    Muon's steps are scaled to the size of Adam's (Liu et al., 2025), so that one learning rate
    serves both.

    Args:
        params: parameters or groups of parameters.
        lr: learning rate of both.
        momentum: momentum of Muon.
        betas: betas of Adam.
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
        super().__init__(params, {"lr": lr, "momentum": momentum})
        self.matrices: list[list[Tensor]] = []
        others: list[dict[str, Any]] = []
        for group in self.param_groups:
            matrices = []
            rest = []
            for parameter in group["params"]:
                is_wide = parameter.ndim == 2 and min(parameter.shape) >= smallest
                if is_wide:
                    matrices.append(parameter)
                else:
                    rest.append(parameter)
            self.matrices.append(matrices)
            others.append({"params": rest})
        self.adam = Adam(others, lr=lr, betas=betas)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Update all parameters once; returns the value of ``closure``."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        self.adam.state = self.state  # the one that is saved in checkpoints, and restored
        groups = zip(self.param_groups, self.matrices, self.adam.param_groups, strict=True)
        for group, matrices, others in groups:
            others["lr"] = group["lr"]
            for matrix in matrices:
                if matrix.grad is not None:
                    self._update(matrix, matrix.grad, group["lr"], group["momentum"])
        self.adam.step()
        return loss

    def _update(self, matrix: Tensor, gradient: Tensor, lr: float, momentum: float) -> None:
        """Update one matrix by Muon with Nesterov's momentum."""
        state = self.state[matrix]
        if not state:
            state["momentum_buffer"] = torch.zeros_like(gradient)
        mean = state["momentum_buffer"].lerp_(gradient, 1 - momentum)
        direction = orthogonalised(gradient.lerp(mean, momentum))
        step = lr * RMS * math.sqrt(max(matrix.shape))
        matrix.sub_(direction, alpha=step)


def orthogonalised(matrix: Tensor) -> Tensor:
    """Return a matrix with the same singular vectors, and singular values near 1.

    By Newton-Schulz iterations. As bfloat16, like ``torch.optim.Muon``, on a GPU only: many CPUs
    emulate it, at ten times the cost of the rest of a training step.

    Args:
        matrix: ``(R, C)``; not zero.
    """
    rows, columns = matrix.shape
    is_tall = rows > columns
    x = matrix
    if is_tall:
        x = matrix.T
    if matrix.is_cuda:
        x = x.to(torch.bfloat16)
    x = x / x.norm().clamp_min(1e-7)
    a, b, c = NEWTON_SCHULZ
    for _ in range(ITERATIONS):
        gram = x @ x.T
        polynomial = torch.addmm(gram, gram, gram, beta=b, alpha=c)
        x = torch.addmm(x, polynomial, x, beta=a)
    if is_tall:
        x = x.T
    return x.to(matrix)
