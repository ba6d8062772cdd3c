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
        return coordinates if coordinates.is_floating_point() else coordinates.double()

    def channels(self, channels: PointChannels) -> Tensor:
        """Return the channels ``(N, C)`` of a model in float64: all further columns.

        Raises:
            UserError: there are more or fewer columns, or values are missing.
        """
        width = 3 + len(channels)
        if self.points.shape[1] != width:
            raise UserError(
                f"points must have {width} columns for this model: x, y, z, "
                f"{', '.join(channels.names)}; got {self.points.shape[1]}."
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
        used = columns[:, scales > 0] * scales[scales > 0]
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
