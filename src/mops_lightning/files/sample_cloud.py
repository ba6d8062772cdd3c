"""Sampling one cloud in the unit of its file: moved into the unit sphere, sampled, mapped back."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.data.formats.guard import check_coordinates
from mops_lightning.files.features import with_channels
from mops_lightning.files.options import Options
from mops_lightning.ops.points import UnitSphere
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.by_normals import ByNormals
from mops_lightning.samplers.tiles import sample_by_tiles


class Generated(NamedTuple):
    """Generated points.

    Attributes:
        points: ``(m, 3)`` in the file's own unit.
        channels: ``(m, C)`` as the sampler returns them; None without channels.
    """

    points: NDArray[np.float64]
    channels: Tensor | None


Sampled = tuple[NDArray[np.int64] | None, Generated | None]
"""The rows ``(m,)`` of kept points, or generated points; the other is None."""


def sample_cloud(
    points: NDArray[np.float64],
    sampler: Sampler,
    m: int,
    options: Options,
    source: Path,
    weight: NDArray[np.float64] | None = None,
    channels: Tensor | None = None,
    normals: NDArray[np.float64] | None = None,
) -> Sampled:
    """Sample a cloud in the file's own unit.

    Args:
        points: ``(N, 3)`` finite, N ≥ m.
        sampler: from ``load_sampler``.
        m: number of points to keep.
        options: how.
        source: the file, for errors.
        weight: ``(N,)`` above 0; None: all points are equal.
        channels: ``(N, C)``, from ``channels_for``.
        normals: ``(N, 3)``, from ``normals_of``, for samplers by normals; None: these estimate
            them. Tiles always do.

    Raises:
        UserError: the coordinates are too large, or tiles keep more points than the sampler can.
    """
    check_coordinates(source, points)
    if options.tile is not None:
        return sample_by_tiles(points, options.tile, m, sampler, channels), None
    weights = None
    if weight is not None:
        weights = torch.from_numpy(weight)[None]
    if sampler.any_unit:
        clouds = torch.from_numpy(points)[None]
        _, rows = sampler.select(options.readout, clouds, m, weights)
        assert rows is not None  # such a sampler generates no points
        return rows[0].numpy(), None
    sphere = UnitSphere.around(points)
    if isinstance(sampler, ByNormals):
        given = None if normals is None else torch.from_numpy(normals)[None]
        return sampler.rows(sphere.normalise(points)[None], m, given)[0].numpy(), None
    seen = with_channels(sphere.normalise(points), channels)
    new, rows = sampler.select(options.readout, seen[None], m, weights)
    if rows is not None:
        return rows[0].numpy(), None
    generated = new[0]
    of_generated = None
    if channels is not None:
        of_generated = generated[:, 3:]
    restored = sphere.restore(generated[:, :3])
    return None, Generated(restored, of_generated)
