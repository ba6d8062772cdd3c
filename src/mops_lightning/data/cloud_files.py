"""Reading the files of a folder of clouds: crops of them, with part numbers and features."""

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from torch import Tensor

from mops_lightning.channels import NO_CHANNELS, PointChannels
from mops_lightning.data.crops import CROPS, CROPS_PER_FILE, Crop, random_crops
from mops_lightning.data.features import (
    Values,
    channels_of,
    check_features,
    feature_values,
    with_channels,
)
from mops_lightning.data.file_splits import SourceFile
from mops_lightning.data.formats.bin_columns import check_columns
from mops_lightning.data.formats.registry import read
from mops_lightning.errors import UserError, check_at_least, did_you_mean
from mops_lightning.ops.points import normalize_unit_sphere
from mops_lightning.seeding import derive_seed
from mops_lightning.types import UNKNOWN


@dataclass(frozen=True)
class Content:
    """What was read from one file.

    Attributes:
        file: the file.
        clouds: ``(crops, n_points, 3)`` float32, in the unit sphere.
        numbers: ``(crops, n_points)`` int64, the part number of every point; None without parts.
        digest: sha256 of a mesh file; empty for other files.
        features: ``(crops, n_points, C)`` in the units of the file; None without features.
    """

    file: SourceFile
    clouds: Tensor
    numbers: NDArray[np.int64] | None = None
    digest: str = ""
    features: Values | None = None


@dataclass(frozen=True)
class Reading:
    """What is read from every file; the attributes are arguments of ``cloud_folder``."""

    n_points: int | None
    crop: Crop
    crops: int | None
    seed: int
    label: str | None
    columns: tuple[str, ...] | None
    features: tuple[str, ...]

    @classmethod
    def of(
        cls,
        n_points: int | None,
        crop: Crop,
        crops: int | None,
        seed: int,
        label: str | None,
        columns: Sequence[str] | None,
        features: Sequence[str] | None,
    ) -> "Reading":
        """Check the arguments.

        Raises:
            UserError: one of them is invalid, or does not fit the crop.
        """
        if n_points is not None:
            check_at_least(2, n_points=n_points)
        elif crop != "whole":
            raise UserError(
                f"n_points must be a number with crop={crop}; null keeps all points of a cloud, "
                "with crop=whole."
            )
        check_at_least(0, seed=seed)
        if crop not in CROPS:
            raise UserError(f"crop: unknown {crop!r}.{did_you_mean(crop, CROPS)}")
        if crop == "tiles" and crops is not None:
            raise UserError(
                f"crops must be null with crop=tiles, whose number follows from a file's points, "
                f"got {crops}."
            )
        if crops is None:
            crops = CROPS_PER_FILE[crop]
        if crops is not None:
            check_at_least(1, crops=crops)
        if crop == "surface":
            _check_surface(crops, label=label, columns=columns, features=features)
        named = None
        if columns is not None:
            named = tuple(check_columns("columns", columns))
        return cls(n_points, crop, crops, seed, label, named, check_features(features))


def _check_surface(crops: int | None, **of_files: Any) -> None:
    """Refuse what surfaces of meshes do not have."""
    if crops != 1:
        raise UserError(f"crops must be 1 with crop=surface, got {crops}.")
    for name, value in of_files.items():
        if value is None:
            continue
        if not isinstance(value, str):
            value = list(value)
        raise UserError(f"{name} must be null with crop=surface, got {value!r}.")


def read_clouds(folder: Path, files: Sequence[SourceFile], reading: Reading) -> list[Content]:
    """Draw crops of every cloud."""
    contents = []
    surface = max(10_000, 8 * (reading.n_points or 0))
    for file in with_progress(files):
        path = folder / file.name
        number_of_file = zlib.crc32(str(file.name).encode())
        rng = np.random.default_rng(derive_seed(reading.seed, number_of_file))
        table = read(path, surface, reading.seed, columns=reading.columns).finite()
        drawn = random_crops(table.points, reading.n_points, reading.crops, reading.crop, rng, path)
        numbers = None
        if reading.label is not None:
            numbers = table.whole_numbers(reading.label, path)[drawn.rows]
            if drawn.own is not None:
                numbers = np.where(drawn.own, numbers, UNKNOWN)
        values = None
        if reading.features:
            values = feature_values(table, reading.features, path, "features")[drawn.rows]
        clouds = normalize_unit_sphere(torch.from_numpy(drawn.points))
        contents.append(Content(file, clouds, numbers, features=values))
    return contents


def append_features(
    contents: Sequence[Content], features: Sequence[str]
) -> tuple[list[Content], PointChannels]:
    """Append the scaled features to the points; also return how they were scaled."""
    if not features:
        return list(contents), NO_CHANNELS
    training = [
        content.features
        for content in contents
        if content.features is not None and content.file.split == "train"
    ]
    channels = channels_of(features, training)
    wider = []
    for content in contents:
        assert content.features is not None
        clouds = with_channels(content.clouds, content.features, channels)
        wider.append(replace(content, clouds=clouds))
    return wider, channels


def with_progress(files: Sequence[SourceFile]) -> Iterable[SourceFile]:
    """Show on a terminal how many files have been read."""
    console = Console(stderr=True)
    return track(files, "Reading files", console=console, disable=not console.is_terminal)
