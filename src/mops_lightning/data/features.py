"""Features of points: columns of files, or estimated from the points, as channels for nets."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mops_lightning.channels import NO_CHANNELS, NORMAL_COLUMNS, NORMALS, Channel, PointChannels
from mops_lightning.data.formats.columns import RESERVED
from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.ops.normals import upward_normals
from mops_lightning.ops.weights import CURVATURE, curvature

STORED_NORMALS = (
    ("nx", "ny", "nz"),
    NORMAL_COLUMNS,
    ("NormalX", "NormalY", "NormalZ"),
)
"""Names of the columns of normals in files."""

ESTIMATED = (NORMALS, CURVATURE)
"""Features that are estimated from the points of a file without such columns."""

Values = NDArray[np.float64]


def check_features(features: Any) -> tuple[str, ...]:
    """Return the features that an argument names; None or empty means none.

    Raises:
        UserError: the argument is no list of different names, or names a coordinate or a part of a
            normal.
    """
    if not features:
        return ()
    is_list = not isinstance(features, str)
    if not is_list or not all(isinstance(name, str) for name in features):
        raise UserError(
            f"features must be a list of names, such as [intensity, normals], got {features!r}."
        )
    names = tuple(features)
    parts_of_normals = {name.lower() for group in STORED_NORMALS for name in group}
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"features: {name} is named twice.")
        if name.lower() in RESERVED:
            raise UserError(f"features: {name} is a coordinate, which every net sees.")
        if name.lower() in parts_of_normals:
            raise UserError(
                f"features: give normals in place of {name}: three channels that turn with the "
                "cloud."
            )
    return names


def feature_values(
    table: Table,
    features: Sequence[str],
    path: Path,
    setting: str,
    estimates: bool = True,
) -> Values:
    """Return the features of a file's points.

    Args:
        table: finite points.
        features: from ``check_features``. Where the file has no columns of them, ``normals`` and
            ``curvature`` are estimated from all points of the table.
        path: the file, for errors.
        setting: what chose the features, for errors.
        estimates: whether features may be estimated; not from a part of a cloud.

    Returns:
        ``(N, C)``, in the units of the file; normals have length 1.

    Raises:
        BadCloudError: the file lacks a feature, or values are missing.
    """
    columns: list[Values] = []
    for name in features:
        values = stored_values(table, name)
        if values is None and estimates:
            values = _estimated(table, name)
        if values is None:
            raise BadCloudError(_missing(table, name, features, path, setting))
        _check_finite(values, name, path, setting)
        columns.append(values)
    return np.concatenate(columns, axis=1)


def find_name(table: Table, name: str) -> str | None:
    """Return a column's name; capitals count only where several names differ in them alone."""
    if name in table.columns:
        return name
    same = [other for other in table.columns if other.lower() == name.lower()]
    if len(same) == 1:
        return same[0]
    return None


def stored_names(table: Table, feature: str) -> tuple[str, ...]:
    """Return the names of a feature's columns in a file; empty if it has none."""
    groups: tuple[tuple[str, ...], ...] = ((feature,),)
    if feature == NORMALS:
        groups = STORED_NORMALS
    for group in groups:
        found = [find_name(table, name) for name in group]
        names = tuple(name for name in found if name is not None)
        if len(names) == len(group):
            return names
    return ()


def stored_values(table: Table, feature: str) -> Values | None:
    """Return a feature's columns ``(N, 1)``, of normals ``(N, 3)``, or None without them.

    Normals of length 0 stay 0.
    """
    names = stored_names(table, feature)
    if not names:
        return None
    columns = [np.asarray(table.columns[name], np.float64) for name in names]
    values = np.stack(columns, axis=1)
    if feature == NORMALS:
        lengths = np.linalg.norm(values, axis=1, keepdims=True)
        values = np.divide(values, lengths, out=values, where=lengths > 0)
    return values


def _estimated(table: Table, feature: str) -> Values | None:
    """Return a feature that follows from the points, or None for any other."""
    if feature == NORMALS:
        return upward_normals(table.points)
    if feature == CURVATURE:
        return curvature(table.points)[:, None]
    return None


def _missing(table: Table, name: str, features: Sequence[str], path: Path, setting: str) -> str:
    if name in ESTIMATED:
        return (
            f"{setting}: {path} has no columns of {name}, which are estimated from all points of a "
            "file at once, not from chunks."
        )
    hint = did_you_mean(name, [*table.columns, *ESTIMATED])
    wanted = ""
    if len(features) > 1:
        wanted = f" of {', '.join(features)}"
    return f"{setting}: {path} has no column {name!r}{wanted}.{hint}"


def _check_finite(values: Values, name: str, path: Path, setting: str) -> None:
    is_finite = np.isfinite(values).all(1)
    number = int((~is_finite).sum())
    if number:
        raise BadCloudError(
            f"{setting}: {number} of {len(values)} points of {path} have no finite {name}. Remove "
            "these points, or leave the feature out."
        )


def channels_of(features: Sequence[str], training: Iterable[Values]) -> PointChannels:
    """Return the channels of features, with the statistics of the training split.

    Args:
        features: from ``check_features``.
        training: features ``(..., C)`` of the training clouds, in the units of files.

    Returns:
        Every channel but normals is scaled to mean 0 and standard deviation 1; a constant one is
        moved only.
    """
    if not features:
        return NO_CHANNELS
    flat = [values.reshape(-1, values.shape[-1]) for values in training]
    rows = np.concatenate(flat)
    columns: list[Channel] = []
    for name in features:
        if name == NORMALS:
            columns += [Channel(part) for part in NORMAL_COLUMNS]
            continue
        values = rows[:, len(columns)]
        mean = float(values.mean())
        spread = float(values.std())
        columns.append(Channel(name, mean, spread if spread > 0 else 1.0))
    return PointChannels(columns)


def with_channels(points: Tensor, values: Values, channels: PointChannels) -> Tensor:
    """Return points ``(..., 3)`` followed by scaled features ``(..., C)``, in float32."""
    scaled = channels.scaled(torch.from_numpy(values))
    scaled = scaled.to(points.dtype)
    return torch.cat([points, scaled], -1)
