"""The contract that every sampler keeps."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError
from mops_lightning.types import SampleOutput


class Sampler(nn.Module):
    """Base of all samplers: checks the input, then calls ``sample``.

    Maps points ``(B, N, 3)`` to a ``SampleOutput`` with points ``(B, M, 3)``.

    Args:
        m: number of points to return; for a flexible sampler the largest number it can return.

    A subclass implements ``sample(points, m)``; a learned one also ``losses``, and one for many
    sizes ``training_sizes``. ``anneal`` is there for what changes in the course of the training.

    Example:
        >>> import torch
        >>> from mops_lightning import SampleOutput, Sampler
        >>> class FirstPoints(Sampler):
        ...     def sample(self, points, m):
        ...         rows = torch.arange(m).expand(len(points), m)
        ...         return SampleOutput(points[:, :m], rows, {})
        >>> FirstPoints(m=8)(torch.rand(2, 64, 3)).points.shape
        torch.Size([2, 8, 3])
    """

    flexible: bool = False
    """Whether one instance takes any 1 ≤ m ≤ ``self.m``; others return ``self.m`` points only."""

    generates: bool = False
    """Whether the points are made, so that matched and completed sets differ from them; the others
    choose input points and return their indices."""

    nested: bool = False
    """Whether the answer for a smaller m is the first m points of the answer for a larger one."""

    size_reduction: Literal["mean", "sum"] = "mean"
    """How the losses at several ``training_sizes`` become one."""

    def __init__(self, m: int) -> None:
        super().__init__()
        if not isinstance(m, int) or m < 1:
            raise UserError(f"m must be a whole number of at least 1, got {m!r}.")
        self.m = m

    def forward(self, points: Tensor, m: int | None = None) -> SampleOutput:
        """Sample every cloud of a batch.

        Args:
            points: ``(B, N, 3)`` floating point, finite, N ≥ m.
            m: how many points to return; None means ``self.m``.

        Returns:
            ``SampleOutput`` with ``(B, m, 3)`` points on the device and in the dtype of the input.

        Raises:
            UserError: ``points`` or ``m`` is not as described.
        """
        m = self.m if m is None else m
        return self.sample_sizes(points, (m,))[m]

    def _checked(self, points: Tensor, m: int) -> SampleOutput:
        """Check the points, then sample, without losses."""
        check_points(points, at_least=m, finite=not (self.training and points.is_cuda))
        own = next((p.dtype for p in self.parameters()), points.dtype)
        if points.dtype != own and not torch.is_autocast_enabled(points.device.type):
            raise UserError(f"points must be {own} as the sampler's weights, got {points.dtype}.")
        return self.sample(points, m)

    def sample_sizes(self, points: Tensor, sizes: Sequence[int]) -> dict[int, SampleOutput]:
        """Sample at several sizes; a nested sampler works once, at the largest.

        Args:
            points: as for ``forward``.
            sizes: each as ``m`` for ``forward``.

        Returns:
            By size, what ``forward`` returns for it.
        """
        if not self.nested and len(sizes) > 1:
            return {m: self(points, m) for m in sizes}
        for m in sizes:
            self._check_m(m)
        whole = self._checked(points, max(sizes))
        losses = self.losses(points, whole, sizes) if self.training else {}
        return {m: whole.first(m)._replace(losses=losses.get(m, {})) for m in sizes}

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Do the work on checked input; see ``forward``."""
        raise NotImplementedError

    def losses(
        self, points: Tensor, output: SampleOutput, sizes: Sequence[int]
    ) -> dict[int, dict[str, Tensor]]:
        """Return, by size, the weighted loss terms of a training output's first points."""
        return {}

    def training_sizes(self) -> tuple[int, ...]:
        """Return the sizes that the next training step learns from; torch's seed draws them."""
        return (self.m,)

    def anneal(self, progress: float) -> None:
        """Tell the sampler how much of the training is done, from 0 to 1; most do not mind."""

    @property
    def learned(self) -> bool:
        """Whether there is anything to train."""
        return any(True for _ in self.parameters())

    def _check_m(self, m: int) -> None:
        if self.flexible and not 1 <= m <= self.m:
            raise UserError(f"m must be between 1 and {self.m}, got {m}.")
        if not self.flexible and m != self.m:
            raise UserError(
                f"m must be {self.m}, the size this {type(self).__name__} was made for, got {m}."
            )


def check_points(points: Tensor, at_least: int = 1, finite: bool = True) -> None:
    """Refuse what is not a batch of clouds with enough points.

    Args:
        points: should be ``(B, N, 3)``, floating point and finite.
        at_least: smallest N allowed.
        finite: also look for NaN and infinity (on a GPU this waits for the device, so training
            there leaves it to the data loading).

    Raises:
        UserError: naming what is allowed and what came.
    """
    if not isinstance(points, Tensor):
        raise UserError(f"points must be a torch.Tensor, got {type(points).__name__}.")
    shape = tuple(points.shape)
    if points.ndim != 3 or points.shape[-1] != 3:
        raise UserError(f"points must have shape (B, N, 3), got {shape}.")
    if not points.is_floating_point():
        raise UserError(f"points must be floating point, got {points.dtype}.")
    if points.shape[0] == 0 or points.shape[1] == 0:
        raise UserError(f"points must hold at least one cloud and one point, got shape {shape}.")
    if points.shape[1] < at_least:
        raise UserError(
            f"m must be at most the number of points N={points.shape[1]}, got m={at_least}."
        )
    if finite and not bool(torch.isfinite(points).all()):
        raise UserError("points must be finite, got NaN or infinity.")
