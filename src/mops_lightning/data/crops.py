"""Random crops of a cloud of any size."""

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.errors import BadCloudError
from mops_lightning.errors import UserError, did_you_mean

Cloud = NDArray[np.float64]
Crop = Literal["nearest", "whole", "surface"]
CROPS = ("nearest", "whole", "surface")

DRAWS = 50
"""Crops that are drawn before a file is rejected because all points of a crop coincide."""


def check_crop(crop: str, crops: int) -> None:
    """Check how crops are to be drawn.

    Raises:
        UserError: the kind is unknown, or the number does not fit to it.
    """
    if crop not in CROPS:
        raise UserError(f"crop: unknown {crop!r}.{did_you_mean(crop, CROPS)}")
    if crop == "surface" and crops != 1:
        raise UserError(f"crops must be 1 with crop=surface, got {crops}.")


def random_crops(
    points: Cloud, n_points: int, number: int, crop: Crop, rng: np.random.Generator, path: Path
) -> NDArray[np.float32]:
    """Draw crops of a cloud, each with its centroid at the origin.

    Args:
        points: ``(N, 3)``, finite, in the file's own unit.
        n_points: number of points per crop.
        number: of crops.
        crop: ``nearest`` takes the points nearest to a point drawn at random, ``whole`` random
            points of the cloud.
        rng: draws all of this.
        path: for errors.

    Returns:
        ``(number, n_points, 3)``, in the file's own unit.

    Raises:
        BadCloudError: the cloud has fewer than ``n_points`` points, or they coincide.
    """
    if len(points) < n_points:
        raise BadCloudError(
            f"{path} has {len(points)} points, fewer than dataset.n_points={n_points}. Lower "
            "dataset.n_points, or remove the file."
        )
    crops = np.empty((number, n_points, 3), np.float32)
    for place in range(number):
        crops[place] = _draw(points, n_points, crop, rng, path)
    return crops


def _draw(points: Cloud, n_points: int, crop: Crop, rng: np.random.Generator, path: Path) -> Cloud:
    """Draw until the points of a crop do not all coincide; return it centred."""
    for _ in range(DRAWS):
        if crop == "nearest":
            drawn = _nearest(points, points[rng.integers(len(points))], n_points)
        else:
            drawn = points[rng.choice(len(points), n_points, replace=False)]
        if (drawn != drawn[0]).any():
            # Before float32, which has too few digits for coordinates of a map.
            return drawn - drawn.mean(0)
    raise BadCloudError(f"{path}: the {n_points} points of a crop coincide. Clean the file.")


def _nearest(points: Cloud, centre: Cloud, n_points: int) -> Cloud:
    """Return the ``n_points`` rows of points nearest to a place, in their order."""
    distance = np.square(points - centre).sum(1)
    return points[np.sort(np.argpartition(distance, n_points - 1)[:n_points])]
