"""One or many clouds of several sizes, columns and types, in the forms in which users give them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.channels import PointChannels
from mops_lightning.errors import UserError
from mops_lightning.ops.points import as_tensor, cloud_sizes
from mops_lightning.ops.weights import CURVATURE, check_weight, curvature
from mops_lightning.samplers.budget import check_scales

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
        if coordinates.is_floating_point():
            return coordinates
        return coordinates.double()

    def channels(self, channels: PointChannels) -> Tensor:
        """Return the channels ``(N, C)`` of a model in float64: all further columns.

        Raises:
            UserError: there are more or fewer columns, or values are missing.
        """
        columns = self.points.shape[1]
        wanted = 3 + len(channels)
        if columns != wanted:
            raise UserError(
                f"points must have {wanted} columns for this model: x, y, z, "
                f"{', '.join(channels.names)}; got {columns}."
            )
        values = self.points[:, 3:].double()
        channels.check_known(values, "points")
        return values

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

    def in_its_type(self, generated: Tensor) -> Tensor:
        """Return generated points in the type of the cloud, where that is floating point."""
        if self.points.is_floating_point():
            return generated.to(self.points.dtype)
        return generated

    def take(self, rows: NDArray[np.int64]) -> "Cloud":
        """Return the cloud of some points."""
        tensor = torch.from_numpy(rows).to(self.points.device)
        weight = self.weight
        if isinstance(weight, Tensor):
            weight = weight[tensor.to(weight.device)]
        return Cloud(self.points[tensor], weight)

    def in_space(self, space: Any) -> NDArray[np.float64]:
        """Return the columns ``(N, k)`` that count in distances, scaled."""
        columns = self.columns()
        if space is None:
            return columns[:, :3]
        scales = np.array(check_scales(space, columns.shape[1]))
        counts = scales > 0
        used = columns[:, counts] * scales[counts]
        if not np.isfinite(used).all():
            raise UserError("space: a column is not finite.")
        return used

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
        _check_shape(tensor, batch)
        if weight is not None and not isinstance(weight, str):
            weight = check_weight(weight, tuple(tensor.shape[:-1]))
        is_array = isinstance(points, np.ndarray)
        if batch is not None:
            return cls._of_flat(tensor, batch, weight, is_array)
        if tensor.ndim == 2:
            return cls([Cloud(tensor, weight)], "one", [is_array])
        clouds = _pair(list(tensor), weight)
        return cls(clouds, "batch", [is_array] * len(clouds))

    @classmethod
    def _of_flat(cls, points: Tensor, batch: Any, weight: Any, is_array: bool) -> "Clouds":
        sizes = cloud_sizes(len(points), as_tensor("batch", batch)).tolist()
        if 0 in sizes:
            raise UserError(f"batch: cloud {sizes.index(0)} has no points. Number from 0.")
        if isinstance(weight, Tensor):
            weight = weight.split(sizes)
        clouds = _pair(list(points.split(sizes)), weight)
        return cls(clouds, "flat", [is_array] * len(clouds))

    @classmethod
    def _of_list(cls, points: Sequence[Any], batch: Any, weight: Any) -> "Clouds":
        if batch is not None:
            raise UserError("batch is for points (P, 3), got a list of clouds as well.")
        if weight is None or isinstance(weight, str):
            weight = [weight] * len(points)
        if not isinstance(weight, list | tuple) or len(weight) != len(points):
            raise UserError(f"weight must be a list for the {len(points)} clouds.")
        clouds = []
        arrays = []
        for points_of_cloud, weight_of_cloud in zip(points, weight, strict=True):
            given = cls.of(points_of_cloud, None, weight_of_cloud)
            if given.form != "one":
                raise UserError("points must be a list of clouds (N, 3), got one of another shape.")
            clouds += given.clouds
            arrays += given.arrays
        return cls(clouds, "list", arrays)

    def join(self, samples: list[Sample], same_size: bool) -> tuple[Any, Any]:
        """Return the samples in the form of the clouds; a batch as one if all have one size."""
        if not samples:
            raise UserError("points must have at least one cloud.")
        if self.form == "one":
            return _as_given(samples[0], self.arrays[0])
        if self.form == "flat":
            return _as_given(self._concatenated(samples), self.arrays[0])
        if self.form == "batch" and same_size:
            return _as_given(_stacked(samples), self.arrays[0])
        all_points = []
        all_rows = []
        for sample, is_array in zip(samples, self.arrays, strict=True):
            points, rows = _as_given(sample, is_array)
            all_points.append(points)
            all_rows.append(rows)
        return all_points, all_rows

    def _concatenated(self, samples: list[Sample]) -> Sample:
        """Join samples in one tensor; rows count in the points of all clouds together."""
        points = torch.cat([sample[0] for sample in samples])
        all_rows = []
        start = 0
        for cloud, (_, rows) in zip(self.clouds, samples, strict=True):
            if rows is None:
                return points, None
            all_rows.append(rows + start)
            start += len(cloud.points)
        return points, torch.cat(all_rows)


def _check_shape(points: Tensor, batch: Any) -> None:
    dimensions: tuple[int, ...] = (2, 3)
    wanted = "(N, 3) or (B, N, 3)"
    if batch is not None:
        dimensions = (2,)
        wanted = "(P, 3) with batch"
    if points.ndim not in dimensions or points.shape[-1] < 3:
        shape = tuple(points.shape)
        raise UserError(f"points must have shape {wanted}, or more columns, got {shape}.")


def _pair(points: Sequence[Tensor], weight: Any) -> list[Cloud]:
    """Return clouds from their points, and one weight for all or a sequence of weights."""
    if weight is None or isinstance(weight, str):
        return [Cloud(of_cloud, weight) for of_cloud in points]
    return [Cloud(of_cloud, own) for of_cloud, own in zip(points, weight, strict=True)]


def _stacked(samples: list[Sample]) -> Sample:
    points = torch.stack([sample[0] for sample in samples])
    rows = [rows for _, rows in samples if rows is not None]
    if not rows:
        return points, None
    return points, torch.stack(rows)


def _as_given(sample: Sample, as_array: bool) -> tuple[Any, Any]:
    points, rows = sample
    if not as_array:
        return points, rows
    if rows is None:
        return points.numpy(), None
    return points.numpy(), rows.numpy()
