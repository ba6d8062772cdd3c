"""A moving average of the weights, which is validated, tested and saved in their place."""

from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import WeightAveraging
from torch.optim.swa_utils import get_ema_multi_avg_fn


class MovingAverage(WeightAveraging):
    """Exponential moving average of weights and running statistics over a share of the training.

    Args:
        span: time constant of the average, as a share of all training steps.
    """

    def __init__(self, span: float) -> None:
        super().__init__()
        self.span = span

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Choose the decay per step for the length of this training."""
        steps = self.span * trainer.estimated_stepping_batches
        assert self._average_model is not None
        average = get_ema_multi_avg_fn(1 - 1 / max(steps, 1.0))

        def update(averaged: Any, current: Any, number: Any) -> None:
            if not averaged[0].is_floating_point():
                # Counters of batches: an average is cut off, also one of equal numbers.
                torch._foreach_copy_(averaged, current)
                return
            # The average keeps 32 bits beside weights in 16 (trainer.precision=bf16-true).
            pairs = zip(averaged, current, strict=True)
            average(averaged, [weight.to(mean.dtype) for mean, weight in pairs], number)

        self._average_model.multi_avg_fn = update

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Apply the average, also if a resumed run has no step left and training never starts."""
        self.on_train_end(trainer, pl_module)
