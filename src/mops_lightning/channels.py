"""Channels of points beside x, y and z: which they are, and how nets see them.

Points with C channels are ``(B, N, 3 + C)``. Distances use the first three columns only.
"""

from collections.abc import Iterable
from math import isfinite
from numbers import Integral
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mops_lightning.errors import UserError

NORMALS = "normals"
"""The feature whose three channels turn with the cloud and have length 1."""

NORMAL_COLUMNS = ("normal_x", "normal_y", "normal_z")
"""Names of its channels."""

MOST = 1000
"""Largest number of channels."""


class Channel(NamedTuple):
    """One number per point.

    Attributes:
        name: of the column in files, or ``normal_x`` and so on.
        mean: in the unit of the file.
        scale: nets see ``(value - mean) / scale``.
    """

    name: str
    mean: float = 0.0
    scale: float = 1.0


class PointChannels:
    """The channels of the points that a net or a sampler takes, in order; immutable.

    Not a dataclass, because Hydra would convert one to a dictionary.

    Args:
        columns: one for each channel.

    Raises:
        UserError: a column is no ``Channel``, or its mean or scale cannot be used.

    Examples:
        >>> from mops_lightning.channels import Channel, PointChannels
        >>> channels = PointChannels((Channel("intensity", 100.0, 50.0),))
        >>> len(channels), channels.scaled(torch.tensor([[150.0]]))
        (1, tensor([[1.]]))
    """

    def __init__(self, columns: Iterable[Channel] = ()) -> None:
        self.columns = tuple(columns)
        for column in self.columns:
            if not isinstance(column, Channel):
                raise UserError(f"PointChannels takes a list of Channel, got {column!r:.99} in it.")
            if not (isfinite(column.mean) and isfinite(column.scale) and column.scale > 0):
                raise UserError(
                    f"{column.name}: a channel's mean and scale must be finite, its scale above 0, "
                    f"got mean {column.mean} and scale {column.scale}."
                )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PointChannels) and self.columns == other.columns

    def __hash__(self) -> int:
        return hash(self.columns)

    def __repr__(self) -> str:
        return f"PointChannels({self.columns!r})"

    @classmethod
    def of(cls, value: Any) -> "PointChannels":
        """Return the channels of an argument ``point_channels``: these, or their number.

        Raises:
            UserError: the argument is neither.
        """
        if isinstance(value, PointChannels):
            return value
        is_whole = isinstance(value, Integral) and not isinstance(value, bool)
        if not is_whole or not 0 <= int(value) <= MOST:
            raise UserError(
                f"point_channels must be a whole number from 0 to {MOST}, or PointChannels, got "
                f"{value!r:.99}."
            )
        numbers = range(1, int(value) + 1)
        return cls(Channel(f"channel_{number}") for number in numbers)

    @classmethod
    def from_plain(cls, rows: Any) -> "PointChannels":
        """Return the channels that ``to_plain`` wrote to a file.

        Raises:
            ValueError: the file holds something else.
        """
        if not isinstance(rows, list) or len(rows) > MOST:
            raise ValueError("channels must be a list")
        columns: list[Channel] = []
        for row in rows:
            is_triple = isinstance(row, list) and len(row) == 3
            if not is_triple or not isinstance(row[0], str):
                raise ValueError("a channel must have a name, a mean and a scale")
            name, mean, scale = row
            columns.append(Channel(name, float(mean), float(scale)))
        return cls(columns)

    def to_plain(self) -> list[list[Any]]:
        """Return the channels as plain data for a file."""
        return [list(column) for column in self.columns]

    def __len__(self) -> int:
        return len(self.columns)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the channels."""
        return tuple(column.name for column in self.columns)

    @property
    def features(self) -> tuple[str, ...]:
        """The channels as ``dataset.features`` names them: normals are one feature."""
        features = []
        for name in self.names:
            if name == NORMAL_COLUMNS[0]:
                features.append(NORMALS)
            elif name not in NORMAL_COLUMNS:
                features.append(name)
        return tuple(features)

    @property
    def normals(self) -> int | None:
        """The first column of the normals among all columns of points, or None."""
        if NORMAL_COLUMNS[0] not in self.names:
            return None
        return 3 + self.names.index(NORMAL_COLUMNS[0])

    def scaled(self, values: Tensor) -> Tensor:
        """Return values ``(..., C)`` of files as nets see them, in the same dtype."""
        mean, scale = self._statistics(values)
        return (values - mean) / scale

    def restored(self, values: Tensor) -> Tensor:
        """Return channels ``(..., C)`` that nets see in the units of files."""
        mean, scale = self._statistics(values)
        return values * scale + mean

    def check_known(self, values: Tensor, where: str) -> None:
        """Refuse missing values among the channels ``(..., C)`` of points, in the units of files.

        Args:
            values: with at least C columns.
            where: the argument or the file, for the error.

        Raises:
            UserError: a value is NaN or infinite; the error names the channel and their number.
        """
        for column, name in enumerate(self.names):
            of_channel = values[..., column]
            missing = int((~torch.isfinite(of_channel)).sum())
            if missing:
                raise UserError(
                    f"{where}: {missing} of {of_channel.numel()} values of {name} are not "
                    "finite. Remove these points, or use another feature."
                )

    def _statistics(self, like: Tensor) -> tuple[Tensor, Tensor]:
        means = [column.mean for column in self.columns]
        scales = [column.scale for column in self.columns]
        return like.new_tensor(means), like.new_tensor(scales)

    def renormalised(self, points: Tensor) -> Tensor:
        """Return points ``(..., 3 + C)`` with normals of length 1; zeros stay zeros."""
        first = self.normals
        if first is None:
            return points
        before, normals, after = points.tensor_split((first, first + 3), -1)
        return torch.cat([before, F.normalize(normals, dim=-1), after], -1)

    def rotated(self, points: Tensor, matrix: Tensor) -> Tensor:
        """Return points ``(B, N, 3 + C)`` times rotations ``(B, 3, 3)``, with their normals."""
        turned = coordinates(points) @ matrix
        first = self.normals
        if first is None:
            return with_coordinates(points, turned)
        _, between, normals, after = points.tensor_split((3, first, first + 3), -1)
        return torch.cat([turned, between, normals @ matrix, after], -1)

    def stretched(self, points: Tensor, factors: Tensor) -> Tensor:
        """Return points whose coordinates are multiplied by ``(B, 1, 3)`` factors above 0."""
        first = self.normals
        result = with_coordinates(points, coordinates(points) * factors)
        if first is None:
            return result
        before, normals, after = result.tensor_split((first, first + 3), -1)
        return self.renormalised(torch.cat([before, normals / factors, after], -1))

    def mapped(self, points: Tensor, matrix: Tensor) -> Tensor:
        """Return points times any invertible matrices ``(B, 3, 3)``; normals stay normal.

        Normals of a surface are mapped by the inverse of the transpose.
        """
        first = self.normals
        result = with_coordinates(points, coordinates(points) @ matrix)
        if first is None:
            return result
        before, normals, after = result.tensor_split((first, first + 3), -1)
        inverse = torch.linalg.inv(matrix)
        moved = torch.cat([before, normals @ inverse.mT, after], -1)
        return self.renormalised(moved)


def coordinates(points: Tensor) -> Tensor:
    """Return the first three columns of ``(..., 3 + C)`` points; without channels, the points."""
    if points.shape[-1] == 3:
        return points
    return points[..., :3]


def with_coordinates(points: Tensor, moved: Tensor) -> Tensor:
    """Return points ``(..., 3 + C)`` at other coordinates ``(..., 3)``, with their channels."""
    if points.shape[-1] == 3:
        return moved
    return torch.cat([moved, points[..., 3:]], -1)


NO_CHANNELS = PointChannels()
"""Points of x, y and z only."""
