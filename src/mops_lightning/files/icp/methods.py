"""Methods of downsampling for registration: those of the package, and small_gicp's own filter."""

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.files.downsample import load_sampler, sample_cloud
from mops_lightning.files.icp.align import small_gicp
from mops_lightning.files.options import Options
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.fps import FARTHEST
from mops_lightning.zoo.find_sampler import untrained
from mops_lightning.zoo.names import UNTRAINED

Points = NDArray[np.float64]

FPS_FARTHEST = "fps_farthest"
FILTER = "small_gicp_voxel"
TRAINED = "trained"

NAMES = (*UNTRAINED, FPS_FARTHEST, FILTER)
"""Methods without training: ``fps_farthest`` starts at the point farthest from the mean."""

BISECTIONS = 40


@dataclass(frozen=True)
class Sample:
    """Chosen points.

    Attributes:
        points: ``(k, 3)``; k is m but for small_gicp's filter, which keeps at most m.
        seconds: processor time of the sampling.
    """

    points: Points
    seconds: float


class Method(ABC):
    """One way to choose points, by its name in the table."""

    name: str

    @abstractmethod
    def sample(self, points: Points, m: int, seed: int, path: Path) -> Sample:
        """Choose m of points ``(N, 3)`` of a file."""


class ByName(Method):
    """A sampler that needs no training."""

    def __init__(self, name: str) -> None:
        self.name = name

    def sample(self, points: Points, m: int, seed: int, path: Path) -> Sample:
        """Choose m of points ``(N, 3)``."""
        options = Options(m, method="fps")
        return _timed(points, m, self._sampler(m, seed), options, path)

    def _sampler(self, m: int, seed: int) -> Sampler:
        if self.name == FPS_FARTHEST:
            return untrained("fps", m, seed, start=FARTHEST)
        return untrained(self.name, m, seed)


class ByWeights(Method):
    """A trained sampler, whose completed sets are taken."""

    name = TRAINED

    def __init__(self, weights: str, tile: int | None, sizes: Sequence[int]) -> None:
        self.options = {m: Options(m, weights, tile=tile) for m in sizes}
        self.samplers = {}
        for m, options in self.options.items():
            self.samplers[m] = load_sampler(options)
        for sampler in self.samplers.values():
            if sampler.point_channels:
                names = ", ".join(sampler.point_channels.features)
                raise UserError(
                    f"--weights: {weights} was trained with the features {names}, but scans are "
                    "registered by x, y and z only. Give a sampler that was trained without "
                    "features."
                )

    def sample(self, points: Points, m: int, seed: int, path: Path) -> Sample:
        """Choose m of points ``(N, 3)``; the seed has no effect."""
        return _timed(points, m, self.samplers[m], self.options[m], path)


class VoxelFilter(Method):
    """The voxel filter of small_gicp, which returns the means of voxels.

    The smallest voxels of which at most m are occupied are found by bisection. Only the filter at
    this size is timed, since a user of the filter gives a size.
    """

    name = FILTER

    def sample(self, points: Points, m: int, seed: int, path: Path) -> Sample:
        """Return at most m means of points ``(N, 3)``; the seed has no effect."""
        extent = float(np.ptp(points, axis=0).max()) or 1.0
        fine = extent / 2**19  # small_gicp's voxels have 21 bits along an axis
        coarse = 2 * extent
        for _ in range(BISECTIONS):
            middle = np.sqrt(fine * coarse)
            if len(_means_of_voxels(points, middle)) > m:
                fine = middle
            else:
                coarse = middle
        began = time.process_time()
        means = _means_of_voxels(points, coarse)
        seconds = time.process_time() - began
        return Sample(means, seconds)


def _means_of_voxels(points: Points, size: float) -> Points:
    """Return the means of the points ``(N, 3)`` in each occupied voxel of a size, ``(K, 3)``.

    small_gicp counts voxels from the origin, and leaves out points beyond voxel 2^20, where those
    in map coordinates may be. So whole voxels are subtracted first.
    """
    corner = np.floor(points.min(0) / size) * size
    means = small_gicp().voxelgrid_sampling(points - corner, size).points()[:, :3]
    return np.ascontiguousarray(means + corner)


def methods_of(
    names: Sequence[str],
    weights: str | None,
    tile: int | None,
    sizes: Sequence[int],
) -> list[Method]:
    """Return the methods of a comparison.

    Raises:
        UserError: a name is unknown, or the trained sampler has channels, or does not choose one
            of the sizes.
    """
    methods: list[Method] = []
    for name in names:
        if name not in NAMES:
            hint = did_you_mean(name, NAMES)
            raise UserError(f"--methods: unknown {name!r}.{hint}")
        if name == FILTER:
            methods.append(VoxelFilter())
        else:
            methods.append(ByName(name))
    if weights is not None:
        methods.append(ByWeights(weights, tile, sizes))
    return methods


def _timed(points: Points, m: int, sampler: Sampler, options: Options, path: Path) -> Sample:
    began = time.process_time()
    rows, _ = sample_cloud(points, sampler, m, options, path)
    seconds = time.process_time() - began
    assert rows is not None  # completed sets are rows
    return Sample(points[rows], seconds)
