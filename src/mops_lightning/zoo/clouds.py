"""Downsampling one or many clouds of several sizes, columns and types, one after the other."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops.points import UnitSphere, as_tensor, cloud_sizes
from mops_lightning.ops.spacing import keep_spaced
from mops_lightning.ops.voxels import representatives, voxel_means
from mops_lightning.ops.weights import CURVATURE, check_positive, check_weight, curvature
from mops_lightning.samplers.budget import as_size, check_distance, check_scales, number_of
from mops_lightning.samplers.fps import FPSSampler, farthest_rows
from mops_lightning.samplers.poisson import poisson_rows
from mops_lightning.samplers.tiles import sample_by_tiles
from mops_lightning.zoo.find_sampler import find_sampler

Sample = tuple[Tensor, Tensor | None]
"""Points ``(m, C)``, and their rows ``(m,)``, None for generated points."""


@dataclass(frozen=True)
class Cloud:
    """One cloud.

    Attributes:
        points: ``(N, C)``, C ≥ 3.
        weight: ``(N,)`` float64 of at least 0, ``"curvature"``, or None.
    """

    points: Tensor
    weight: Tensor | str | None

    @property
    def coordinates(self) -> Tensor:
        """The first three columns, floating point."""
        coordinates = self.points[:, :3]
        return coordinates if coordinates.is_floating_point() else coordinates.double()

    def columns(self) -> NDArray[np.float64]:
        """Return all columns in float64."""
        columns: NDArray[np.float64] = self.points.detach().cpu().double().numpy()
        if not np.isfinite(columns[:, :3]).all():
            raise UserError("points must be finite, got NaN or infinity.")
        return columns

    def rows(self, rows: NDArray[np.int64]) -> Sample:
        """Return the points of rows, and these."""
        tensor = torch.from_numpy(rows).to(self.points.device)
        return self.points[tensor], tensor

    def numbers(self) -> NDArray[np.float64] | None:
        """Return the weights as an array."""
        if self.weight is None:
            return None
        if isinstance(self.weight, Tensor):
            weights: NDArray[np.float64] = self.weight.cpu().numpy()
            return weights
        if self.weight != CURVATURE:
            raise UserError(f"weight must be {CURVATURE!r} or numbers, got {self.weight!r:.99}.")
        return curvature(self.columns()[:, :3])


@dataclass(frozen=True)
class Clouds:
    """All clouds of a call, and the form in which they were given.

    Attributes:
        clouds: one by one.
        form: one cloud, a batch ``(B, N, C)``, a list, or ``(P, C)`` with the cloud of each point.
        arrays: for every cloud, whether it was given as an array.
    """

    clouds: list[Cloud]
    form: Literal["one", "batch", "list", "flat"]
    arrays: list[bool]

    @classmethod
    def of(cls, points: Any, batch: Any, weight: Any) -> "Clouds":
        """Split and check the arguments of ``downsample``."""
        if isinstance(points, list | tuple):
            return cls._of_list(points, batch, weight)
        tensor = as_tensor("points", points)
        is_one = tensor.ndim == 2
        if tensor.ndim not in (2, 3) or tensor.shape[-1] < 3 or (batch is not None and not is_one):
            wanted = "(N, 3) or (B, N, 3)" if batch is None else "(P, 3) with batch"
            raise UserError(
                f"points must have shape {wanted}, or more columns, got {tuple(tensor.shape)}."
            )
        if weight is not None and not isinstance(weight, str):
            weight = check_weight(weight, tuple(tensor.shape[:-1]))
        is_array = isinstance(points, np.ndarray)
        if batch is not None:
            sizes = cloud_sizes(len(tensor), as_tensor("batch", batch)).tolist()
            if 0 in sizes:
                raise UserError(f"batch: cloud {sizes.index(0)} has no points. Number from 0.")
            parts = list(tensor.split(sizes))
            weights = weight.split(sizes) if isinstance(weight, Tensor) else [weight] * len(sizes)
            clouds = [Cloud(*pair) for pair in zip(parts, weights, strict=True)]
            return cls(clouds, "flat", [is_array] * len(clouds))
        if is_one:
            return cls([Cloud(tensor, weight)], "one", [is_array])
        weights = list(weight) if isinstance(weight, Tensor) else [weight] * len(tensor)
        clouds = [Cloud(*pair) for pair in zip(tensor, weights, strict=True)]
        return cls(clouds, "batch", [is_array] * len(clouds))

    @classmethod
    def _of_list(cls, points: Sequence[Any], batch: Any, weight: Any) -> "Clouds":
        if batch is not None:
            raise UserError("batch is for points (P, 3), got a list of clouds as well.")
        if weight is None or isinstance(weight, str):
            weight = [weight] * len(points)
        if not isinstance(weight, list | tuple) or len(weight) != len(points):
            raise UserError(f"weight must be a list for the {len(points)} clouds.")
        parts = [cls.of(*pair) for pair in zip(points, [None] * len(points), weight, strict=True)]
        if any(part.form != "one" for part in parts):
            raise UserError("points must be a list of clouds (N, 3), got one of another shape.")
        return cls([part.clouds[0] for part in parts], "list", [part.arrays[0] for part in parts])

    def join(self, samples: list[Sample], same_size: bool) -> tuple[Any, Any]:
        """Return the samples in the form of the clouds; a batch as one if all have one size."""
        if not samples:
            raise UserError("points must have at least one cloud.")
        if self.form == "one":
            return _as_given(samples[0], self.arrays[0])
        if self.form == "flat":
            sizes = [len(cloud.points) for cloud in self.clouds]
            starts = np.cumsum([0, *sizes[:-1]]).tolist()
            rows = [
                rows + start
                for (_, rows), start in zip(samples, starts, strict=True)
                if rows is not None
            ]
            together = torch.cat([points for points, _ in samples])
            is_selected = len(rows) == len(samples)
            return _as_given((together, torch.cat(rows) if is_selected else None), self.arrays[0])
        if self.form == "batch" and same_size:
            rows = [rows for _, rows in samples if rows is not None]
            stacked = torch.stack([points for points, _ in samples])
            return _as_given((stacked, torch.stack(rows) if rows else None), self.arrays[0])
        given = [_as_given(*pair) for pair in zip(samples, self.arrays, strict=True)]
        return [points for points, _ in given], [rows for _, rows in given]


def _as_given(sample: Sample, as_array: bool) -> tuple[Any, Any]:
    points, rows = sample
    if not as_array:
        return points, rows
    return points.numpy(), None if rows is None else rows.numpy()


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
    clouds = Clouds.of(points, batch, weight)
    if spacing is not None:
        distance = check_distance("spacing", spacing)
        if readout == "generated":
            raise UserError("readout: spacing keeps input points, and generates none.")
        samples = [_spaced(cloud, distance, seed, space) for cloud in clouds.clouds]
        return clouds.join(samples, same_size=False)
    size = check_distance("voxel", voxel)
    if space is not None:
        raise UserError("space is for fps, poisson and spacing; voxels are cubes of coordinates.")
    if readout == "generated":
        if weight is not None:
            raise UserError("weight: the means of voxels take no weights.")
        return clouds.join([_voxel_means(cloud, size) for cloud in clouds.clouds], same_size=False)
    samples = [_voxels(cloud, size) for cloud in clouds.clouds]
    return clouds.join(samples, same_size=False)


def _spaced(cloud: Cloud, spacing: float, seed: int, space: Any) -> Sample:
    columns = cloud.columns()
    weight = cloud.numbers()
    used = _in_space(columns, space)
    if weight is None:
        return cloud.rows(keep_spaced(used, spacing, seed))
    heavy = np.flatnonzero(weight)
    return cloud.rows(heavy[keep_spaced(used[heavy], spacing, seed, weight[heavy])])


def _in_space(columns: NDArray[np.float64], space: Any) -> NDArray[np.float64]:
    """Return the columns ``(N, k)`` that count in distances, scaled."""
    if space is None:
        return columns[:, :3]
    scales = np.array(check_scales(space, columns.shape[1]))
    used = columns[:, scales > 0] * scales[scales > 0]
    if not np.isfinite(used).all():
        raise UserError("space: a column is not finite.")
    return used


def _voxels(cloud: Cloud, size: float) -> Sample:
    columns = cloud.columns()[:, :3]
    weight = cloud.numbers()
    if weight is None:
        return cloud.rows(np.sort(representatives(columns, size).rows))
    heavy = np.flatnonzero(weight)
    rows = representatives(columns[heavy], size, weight=weight[heavy]).rows
    return cloud.rows(heavy[np.sort(rows)])


def _voxel_means(cloud: Cloud, size: float) -> Sample:
    means = torch.from_numpy(voxel_means(cloud.columns(), size)).to(cloud.points.device)
    is_floating = cloud.points.is_floating_point()
    return means.to(cloud.points.dtype) if is_floating else means, None


def to_number(
    points: Any,
    m: Any,
    method: str | Path,
    readout: str,
    batch: Any,
    start: int | str | None,
    seed: int | None,
    weight: Any,
    *,
    space: Any,
    tile: int | None,
) -> tuple[Any, Any]:
    """Downsample clouds to numbers of points; see ``downsample``."""
    clouds = Clouds.of(points, batch, weight)
    is_per_cloud = isinstance(m, list | tuple)
    sizes = [as_size(size) for size in m] if is_per_cloud else [m] * len(clouds.clouds)
    if len(sizes) != len(clouds.clouds):
        raise UserError(f"m: {len(sizes)} numbers for {len(clouds.clouds)} clouds.")
    _check_space_and_tile(space, tile, method, weight, readout)

    def sample(cloud: Cloud, number: int) -> Sample:
        if len(cloud.points) <= number and clouds.form in ("list", "flat"):
            return cloud.rows(np.arange(len(cloud.points)))
        if number > len(cloud.points):
            raise UserError(
                f"m must be at most the number of points N={len(cloud.points)}, got m={number}."
            )
        if space is not None:
            return _sample_in_space(cloud, number, str(method), space, start, seed or 0)
        sampler = find_sampler(method, number, cloud.points, start, seed)
        if tile is not None:
            columns = cloud.columns()[:, :3]
            return cloud.rows(sample_by_tiles(columns, tile, number, sampler))
        new, rows = sampler.downsample(cloud.coordinates, number, readout, None, cloud.weight)
        if rows is not None:
            return cloud.points[rows], rows
        if cloud.points.shape[1] > 3:
            raise UserError("generated points have coordinates only: give points[..., :3].")
        return new, None

    numbers = [
        number_of(size, len(cloud.points)) for size, cloud in zip(sizes, clouds.clouds, strict=True)
    ]
    samples = [sample(*pair) for pair in zip(clouds.clouds, numbers, strict=True)]
    return clouds.join(samples, same_size=not is_per_cloud)


def _check_space_and_tile(
    space: Any, tile: Any, method: str | Path, weight: Any, readout: str
) -> None:
    if space is not None and method not in ("fps", "poisson"):
        raise UserError(
            f"space is for method='fps', method='poisson' and spacing, got {str(method)!r}."
        )
    if space is not None and tile is not None:
        raise UserError("give space or tile, not both.")
    if tile is None:
        return
    if isinstance(tile, bool) or not isinstance(tile, int) or tile < 2:
        raise UserError(f"tile must be a whole number of at least 2, got {tile!r:.99}.")
    if weight is not None:
        raise UserError("weight needs the whole cloud at once: leave tile out.")
    if readout != "completed":
        raise UserError(f"tile keeps different input points: no readout {readout!r:.99}.")


def _sample_in_space(
    cloud: Cloud, number: int, method: str, space: Any, start: int | str | None, seed: int
) -> Sample:
    """Choose farthest points, or those of sample elimination, by the columns that count."""
    FPSSampler(number, seed, start)  # checks the start
    choose = poisson_rows if method == "poisson" else partial(farthest_rows, start=start)
    used = _in_space(cloud.columns(), space)
    points = UnitSphere.around(used).normalise(used)[None]
    weight = cloud.numbers()
    if weight is None:
        return cloud.rows(choose(points, number, seed)[0].numpy())
    heavy = np.flatnonzero(weight)
    check_positive(len(heavy), number)
    weights = torch.from_numpy(weight[heavy])[None]
    rows = choose(points[:, heavy], number, seed, weight=weights)[0]
    return cloud.rows(heavy[rows.numpy()])
