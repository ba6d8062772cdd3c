"""Downsampling clouds to a spacing or to voxels, one after the other."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from mops_lightning.errors import UserError
from mops_lightning.ops.spacing import keep_spaced
from mops_lightning.ops.voxels import representatives, voxel_means
from mops_lightning.samplers.budget import check_distance
from mops_lightning.zoo.clouds import Cloud, Clouds, Sample


def to_distance(
    points: Any,
    method: str | Path,
    readout: str,
    batch: Any,
    seed: int,
    weight: Any,
    spacing: float | None,
    voxel: float | None,
    space: Any,
) -> tuple[Any, Any]:
    """Downsample clouds to a spacing or to voxels; see ``downsample``."""
    if method != "fps":
        raise UserError(f"method needs m: spacing and voxel take none, got {str(method)!r}.")
    if readout not in ("completed", "matched", "generated"):
        raise UserError(f"readout must be completed or generated, got {readout!r:.99}.")
    is_generated = readout == "generated"
    clouds = Clouds.of(points, batch, weight)
    if spacing is not None:
        distance = check_distance("spacing", spacing)
        if is_generated:
            raise UserError("readout: spacing keeps input points, and generates none.")
        samples = [_spaced(cloud, distance, seed, space) for cloud in clouds.clouds]
        return clouds.join(samples, same_size=False)
    size = check_distance("voxel", voxel)
    if space is not None:
        raise UserError("space is for fps, poisson and spacing; voxels are cubes of coordinates.")
    if is_generated and weight is not None:
        raise UserError("weight: the means of voxels take no weights.")
    sample_voxels = _voxels
    if is_generated:
        sample_voxels = _voxel_means
    samples = [sample_voxels(cloud, size) for cloud in clouds.clouds]
    return clouds.join(samples, same_size=False)


def _spaced(cloud: Cloud, spacing: float, seed: int, space: Any) -> Sample:
    weight = cloud.numbers()
    used = cloud.in_space(space)
    if weight is None:
        return cloud.rows(keep_spaced(used, spacing, seed))
    heavy = np.flatnonzero(weight)
    kept = keep_spaced(used[heavy], spacing, seed, weight[heavy])
    return cloud.rows(heavy[kept])


def _voxels(cloud: Cloud, size: float) -> Sample:
    columns = cloud.columns()[:, :3]
    weight = cloud.numbers()
    if weight is None:
        return cloud.rows(np.sort(representatives(columns, size).rows))
    heavy = np.flatnonzero(weight)
    rows = representatives(columns[heavy], size, weight=weight[heavy]).rows
    return cloud.rows(heavy[np.sort(rows)])


def _voxel_means(cloud: Cloud, size: float) -> Sample:
    means = torch.from_numpy(voxel_means(cloud.columns(), size))
    return cloud.in_its_type(means.to(cloud.points.device)), None
