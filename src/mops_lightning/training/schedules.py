"""Learning rate schedules.

Each is a factor per step and has no state, so that a resumed run may be longer.
"""

import math

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from mops_lightning.errors import UserError

START_FACTOR = 0.04
"""First learning rate of one cycle over its peak."""
END_FACTOR = 1e-4
"""Last learning rate of one cycle over its peak."""


def one_cycle(optimizer: Optimizer, total_steps: int, warmup: float = 0.3) -> LambdaLR:
    """Increase to the optimizer's rate along a half cosine, then decrease (Smith and Topin, 2018).

    Args:
        optimizer: its learning rate is the peak.
        total_steps: optimizer steps in the run.
        warmup: fraction of the run in which the rate increases.

    Raises:
        UserError: ``warmup`` is not between 0 and 1.
    """
    if not 0 <= warmup <= 1:
        raise UserError(f"warmup must be between 0 and 1, got {warmup}.")
    last = max(total_steps - 1, 1)
    peak = warmup * total_steps - 1

    def factor(step: int) -> float:
        step = min(step, last)
        if step < peak:
            return _half_cosine(START_FACTOR, 1 - step / peak)
        return _half_cosine(END_FACTOR, (step - peak) / max(last - peak, 1))

    return LambdaLR(optimizer, factor)


def _half_cosine(low: float, share: float) -> float:
    """Return a factor that falls from 1 to ``low`` while the share of the way rises from 0 to 1."""
    height = (1 + math.cos(math.pi * share)) / 2
    return low + (1 - low) * height


def exponential(optimizer: Optimizer, total_steps: int, end_lr: float) -> LambdaLR:
    """Decay exponentially from the optimizer's rate to ``end_lr``, as in the paper.

    Args:
        optimizer: its learning rate is the first one.
        total_steps: optimizer steps in the run.
        end_lr: rate of the last step.

    Raises:
        UserError: ``end_lr`` is not positive.
    """
    if end_lr <= 0:
        raise UserError(f"end_lr must be positive, got {end_lr}.")
    first_lr = optimizer.param_groups[0]["lr"]
    ratio = end_lr / first_lr
    last = max(total_steps - 1, 1)

    def factor(step: int) -> float:
        share = min(step / last, 1.0)
        return ratio**share

    return LambdaLR(optimizer, factor)


def step_decay(
    optimizer: Optimizer, total_steps: int, every: int, factor: float, floor_lr: float
) -> LambdaLR:
    """Multiply the rate by ``factor`` every ``every`` steps, down to ``floor_lr``.

    PointNet, S-Net and SampleNet were trained so: ×0.7 per 200,000 or 600,000 samples.

    Args:
        optimizer: its learning rate is the first one.
        total_steps: unused; all schedules share this signature.
        every: steps between two decays.
        factor: factor of one decay.
        floor_lr: smallest rate.

    Raises:
        UserError: ``every`` or ``factor`` is out of range.
    """
    if every < 1:
        raise UserError(f"every must be at least 1, got {every}.")
    if not 0 < factor <= 1:
        raise UserError(f"factor must be above 0 and at most 1, got {factor}.")
    first_lr = optimizer.param_groups[0]["lr"]
    lowest = floor_lr / first_lr

    def decayed(step: int) -> float:
        decays = step // every
        return max(factor**decays, lowest)

    return LambdaLR(optimizer, decayed)
