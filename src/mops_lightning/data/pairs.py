"""Pairs for registration: a cloud and a copy under a random motion."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.rigid import Motion, random_motion
from mops_lightning.types import PairBatch

ROTATION = 45.0
"""Largest angle about each axis, in degrees, as PCRNet's authors chose it."""
TRANSLATION = 1.0
"""Largest translation along each axis, in units of the coordinates."""


@dataclass(frozen=True)
class Pairs:
    """Converts clouds to pairs of source and target.

    The target is the source under a random motion, with uniform angles about the fixed axes x, y
    and z and a uniform translation (paper section "Registration-oriented Downsampling").

    Attributes:
        resample: number of points of source and target, drawn independently from the shape, so that
            both have different points of one surface; None uses all points in both.

    Raises:
        UserError: ``resample`` is below 1.
    """

    resample: int | None = None

    def __post_init__(self) -> None:
        """Check the arguments."""
        if self.resample is not None and self.resample < 1:
            raise UserError(f"resample must be None or at least 1, got {self.resample}.")

    def __call__(self, points: Tensor, generators: Sequence[Generator]) -> PairBatch:
        """Convert every cloud to a pair.

        Args:
            points: ``(B, N, 3)``.
            generators: B generators; each determines the pair of its cloud.

        Returns:
            B pairs.

        Raises:
            UserError: ``resample`` is larger than N.
        """
        n_points = points.shape[1]
        if self.resample is not None and self.resample > n_points:
            raise UserError(
                f"resample must be at most the {n_points} points of a shape, got {self.resample} "
                "(task.resample and dataset.n_points on the command line)."
            )
        motion = random_motion(ROTATION, TRANSLATION, generators)
        source = target = points
        if self.resample is not None:
            source, target = (self._drawn(points, generators) for _ in range(2))
        target = motion.apply(target)
        return pair_batch(source, target, motion)

    def _drawn(self, points: Tensor, generators: Sequence[Generator]) -> Tensor:
        rows = [torch.randperm(points.shape[1], generator=g)[: self.resample] for g in generators]
        return gather_points(points, torch.stack(rows))


def pair_batch(source: Tensor, target: Tensor, motion: Motion) -> PairBatch:
    """Combine sources and targets into a batch, with every centroid at the origin.

    Args:
        source: ``(B, N, 3)`` the clouds to register.
        target: ``(B, N, 3)`` the clouds to register them to.
        motion: the true motions from source to target.
    """
    both = torch.cat([source, target])
    centroids = both.mean(1)
    return PairBatch(both - centroids[:, None], centroids, motion.quaternion, motion.translation)
