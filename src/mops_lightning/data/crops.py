"""Random crops of a cloud of any size."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.errors import BadCloudError
from mops_lightning.errors import UserError, did_you_mean

Cloud = NDArray[np.float64]
Crop = Literal["nearest", "cube", "whole"]
CROPS = ("nearest", "cube", "whole")

DRAWS = 50
"""Centres that are drawn for one crop before the file is rejected."""


def random_crops(
    points: Cloud,
    n_points: int,
    number: int,
    crop: Crop,
    crop_size: float | None,
    rng: np.random.Generator,
    path: Path,
) -> NDArray[np.float32]:
    """Draw crops of a cloud, each with its centroid at the origin.

    Args:
        points: ``(N, 3)``, finite, in the file's own unit.
        n_points: number of points per crop.
        number: of crops.
        crop: ``nearest`` takes the points nearest to a point drawn at random, ``cube`` random
            points of a cube around it, ``whole`` random points of the cloud.
        crop_size: side of the cube, in the file's own unit.
        rng: draws all of this.
        path: for errors.

    Returns:
        ``(number, n_points, 3)``, in the file's own unit.

    Raises:
        BadCloudError: the cloud has fewer than ``n_points`` points, or no cube with as many.
    """
    check_number(points, n_points, path)
    draw: Callable[[], Cloud] = {
        "nearest": lambda: nearest(points, points[rng.integers(len(points))], n_points),
        "cube": lambda: _cube(points, n_points, crop_size or 0.0, rng),
        "whole": lambda: points[rng.choice(len(points), n_points, replace=False)],
    }[crop]
    crops = np.empty((number, n_points, 3), np.float32)
    for place in range(number):
        crops[place] = _usable(draw, n_points, crop_size if crop == "cube" else None, path)
    return crops


def _usable(draw: Callable[[], Cloud], n_points: int, side: float | None, path: Path) -> Cloud:
    """Draw until a crop has enough points that do not all coincide; return it centred."""
    largest = 0
    for _ in range(DRAWS):
        drawn = draw()
        if len(drawn) == n_points and (drawn != drawn[0]).any():
            # Before float32, which has too few digits for coordinates of a map.
            return drawn - drawn.mean(0)
        largest = max(largest, len(drawn))
    if side is not None and largest < n_points:
        raise BadCloudError(
            f"{path}: crop_size={side:g} is too small for n_points={n_points}: the fullest of "
            f"{DRAWS} cubes has {largest} points. Increase crop_size or lower n_points."
        )
    raise BadCloudError(f"{path}: the {n_points} points of a crop coincide. Clean the file.")


def check_crop(crop: str, crop_size: float | None) -> None:
    """Check how crops are to be drawn.

    Raises:
        UserError: the kind is unknown, or the size does not belong to it or is out of range.
    """
    if crop not in CROPS:
        raise UserError(f"crop: unknown {crop!r}.{did_you_mean(crop, CROPS)}")
    if (crop == "cube") != (crop_size is not None):
        raise UserError(
            "crop_size is the side of the cubes of crop=cube: give both or neither, got "
            f"crop={crop} and crop_size={crop_size}."
        )
    if crop_size is not None and not 0 < crop_size < float("inf"):
        raise UserError(f"crop_size must be above 0 and finite, got {crop_size}.")


def check_number(points: Cloud, n_points: int, path: Path) -> None:
    """Reject a cloud of fewer points than a crop has.

    Raises:
        BadCloudError: it has fewer.
    """
    if len(points) < n_points:
        raise BadCloudError(
            f"{path} has {len(points)} points, fewer than dataset.n_points={n_points}. Lower "
            "dataset.n_points, or leave the file out."
        )


def nearest(points: Cloud, centre: Cloud, n_points: int) -> Cloud:
    """Return the ``n_points`` rows of points nearest to a place, in their order.

    Args:
        points: ``(N, 3)``.
        centre: ``(3,)`` or longer; the coordinates count.
        n_points: how many.
    """
    distance = np.square(points[:, :3] - centre[:3]).sum(1)
    return points[np.sort(np.argpartition(distance, n_points - 1)[:n_points])]


def _cube(points: Cloud, n_points: int, side: float, rng: np.random.Generator) -> Cloud:
    """Return random points of a cube, or all of them if there are too few."""
    inside = in_cube(points, points[rng.integers(len(points))], side)
    if len(inside) < n_points:
        return points[inside]
    return points[rng.choice(inside, n_points, replace=False)]


def in_cube(points: Cloud, centre: Cloud, side: float) -> NDArray[np.int64]:
    """Return the rows of the points in a cube around a place, ascending; see ``nearest``."""
    return np.flatnonzero((np.abs(points[:, :3] - centre[:3]) <= side / 2).all(1))
