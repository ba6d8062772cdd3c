"""Pairs for registration: a cloud and a copy under a random motion."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.rigid import Motion, random_motion
from mops_lightning.types import PairBatch


@dataclass(frozen=True)
class Pairs:
    """Converts clouds to pairs of source and target.

    The target is the source under a random motion, with uniform angles about the fixed axes x, y
    and z and a uniform translation (paper section "Registration-oriented Downsampling"). The
    default ranges are those of PCRNet's authors.

    Attributes:
        rotation: largest angle about each axis, in degrees, from 0 to 180.
        translation: largest translation along each axis, in units of the coordinates.
        resample: number of points of source and target, drawn independently from the shape, so that
            both have different points of one surface; None uses all points in both.
        jitter: standard deviation of the noise added to every coordinate of both clouds.
        jitter_clip: largest absolute noise.
        overlap: share of points that are in both clouds, above 0 and at most 1. Source and target
            lose opposite ends of the shape along a random direction; each keeps (1 + overlap)/2.
        test_seed: seed of the test pairs, independent of the seed of the run.

    Raises:
        UserError: an argument is out of range.
    """

    rotation: float = 45.0
    translation: float = 1.0
    resample: int | None = None
    jitter: float = 0.0
    jitter_clip: float = 0.05
    overlap: float = 1.0
    test_seed: int = 0

    def __post_init__(self) -> None:
        """Check the arguments."""
        ranges = {
            "rotation": (0 <= self.rotation <= 180, "from 0 to 180 degrees"),
            "translation": (0 <= self.translation < math.inf, "a number of at least 0"),
            "resample": (self.resample is None or self.resample >= 1, "None or at least 1"),
            "jitter": (0 <= self.jitter < math.inf, "a number of at least 0"),
            "jitter_clip": (0 <= self.jitter_clip < math.inf, "a number of at least 0"),
            "overlap": (0 < self.overlap <= 1, "above 0 and at most 1"),
            "test_seed": (0 <= self.test_seed < 2**63, "a whole number from 0 to 2^63 - 1"),
        }
        for name, (fits, allowed) in ranges.items():
            if not fits:
                raise UserError(f"{name} must be {allowed}, got {getattr(self, name)}.")

    def points_of(self, n_points: int) -> int:
        """Return the number of points of source and target for shapes with ``n_points``.

        Raises:
            UserError: ``resample`` is larger than ``n_points``.
        """
        if self.resample is not None and self.resample > n_points:
            raise UserError(
                f"resample must be at most the {n_points} points of a shape, got {self.resample} "
                "(task.pairs.resample and dataset.n_points on the command line)."
            )
        drawn = self.resample or n_points
        return max(round(drawn * (1 + self.overlap) / 2), 1)

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
        kept = self.points_of(points.shape[1])
        motion = random_motion(self.rotation, self.translation, generators)
        source = target = points
        if self.resample is not None:
            source, target = (self._drawn(one, generators) for one in (source, target))
        if kept < source.shape[1]:
            direction = torch.stack([torch.randn(3, 1, generator=g) for g in generators])
            source = _cut(source, direction, kept)
            target = _cut(target, -direction, kept)
        target = motion.apply(target)
        if self.jitter:
            source = source + self._noise(source, generators)
            target = target + self._noise(target, generators)
        return pair_batch(source, target, motion)

    def _drawn(self, points: Tensor, generators: Sequence[Generator]) -> Tensor:
        rows = [torch.randperm(points.shape[1], generator=g)[: self.resample] for g in generators]
        return gather_points(points, torch.stack(rows))

    def _noise(self, cloud: Tensor, generators: Sequence[Generator]) -> Tensor:
        noise = torch.stack([torch.randn(cloud.shape[1:], generator=g) for g in generators])
        return noise.mul_(self.jitter).clamp_(-self.jitter_clip, self.jitter_clip)


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


def _cut(points: Tensor, direction: Tensor, kept: int) -> Tensor:
    """Keep the farthest points along a direction ``(B, 3, 1)``, in their order."""
    rows = (points @ direction)[..., 0].topk(kept, dim=1)[1].sort(1).values
    return gather_points(points, rows)
