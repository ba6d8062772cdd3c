"""Channels of a file's points for a trained sampler, and of generated points for a file."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mops_lightning.channels import NORMALS, PointChannels
from mops_lightning.data.features import STORED_NORMALS, Values, feature_values, stored_names
from mops_lightning.data.formats.table import Column, Table
from mops_lightning.files.column_means import as_stored

SETTING = "--weights"
"""What chooses the features of a file, for errors."""


def channels_for(
    table: Table, channels: PointChannels, source: Path, estimates: bool = True
) -> Tensor | None:
    """Return the channels ``(N, C)`` of a file's points as a sampler was trained; None without.

    Args:
        table: finite points.
        channels: of the sampler. Columns are found by their names, in any order.
        source: the file, for errors.
        estimates: whether the table has all points of the file, from which features are estimated.

    Raises:
        BadCloudError: the file lacks a feature, or values are missing.
    """
    if not channels:
        return None
    values = feature_values(table, channels.features, source, SETTING, estimates)
    scaled = channels.scaled(torch.from_numpy(values))
    return scaled.float()


def with_channels(places: Tensor, values: Tensor | None) -> Tensor:
    """Return places ``(N, 3)`` followed by channels ``(N, C)``, if there are any."""
    if values is None:
        return places
    return torch.cat([places, values], 1)


def generated_columns(
    table: Table, channels: PointChannels, generated: Tensor
) -> Mapping[str, Column]:
    """Return the channels of generated points as columns of their file.

    Args:
        table: the file's points, for names and types of columns. Features without columns are
            written in float32, normals as nx, ny and nz.
        channels: of the sampler.
        generated: ``(m, C)``, as the sampler returns them.
    """
    values: Values = channels.restored(generated.double()).numpy()
    columns: dict[str, Column] = {}
    first = 0
    for feature in channels.features:
        names = stored_names(table, feature)
        expected: tuple[str, ...] = (feature,)
        if feature == NORMALS:
            expected = STORED_NORMALS[0]
        width = len(expected)
        of_feature = values[:, first : first + width].T
        if not names:
            for name, column in zip(expected, of_feature, strict=True):
                columns[name] = column.astype(np.float32)
        else:
            for name, column in zip(names, of_feature, strict=True):
                columns[name] = as_stored(column, table.columns[name])
        first += width
    return columns
