"""Crops: parts of a cloud, each with as many points as a net is trained on."""

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.guard import BadCloudError

Crop = Literal["nearest", "whole", "surface"]
CROPS = ("nearest", "whole", "surface")

CROPS_PER_FILE = {
    "nearest": 32,
    "whole": 1,
    "surface": 1,
}
"""Number of clouds that are drawn from a file, unless ``crops`` sets it."""

DRAWS = 50
"""Crops that are drawn before a file is rejected because all points of a crop coincide."""


class Crops(NamedTuple):
    """Crops of one cloud.

    Attributes:
        points: ``(crops, n_points, 3)`` float32, each crop with its centroid at the origin.
        rows: ``(crops, n_points)`` int64, the rows of these points in the cloud.
    """

    points: NDArray[np.float32]
    rows: NDArray[np.int64]


def random_crops(
    points: NDArray[np.float64],
    n_points: int,
    number: int,
    crop: Crop,
    rng: np.random.Generator,
    path: Path,
) -> Crops:
    """Draw crops of a cloud.

    Args:
        points: ``(N, 3)``.
        n_points: number of points per crop.
        number: of crops.
        crop: ``nearest`` or ``whole``, as in ``cloud_folder.cloud_folder``.
        rng: random generator.
        path: of the file, for errors.

    Raises:
        BadCloudError: the cloud has fewer than ``n_points`` points, or they coincide.
    """
    if len(points) < n_points:
        raise BadCloudError(
            f"{path} has {len(points)} points, fewer than dataset.n_points={n_points}. Lower "
            "dataset.n_points, or remove the file."
        )
    centred = np.empty((number, n_points, 3), np.float32)
    rows = np.empty((number, n_points), np.int64)
    for place in range(number):
        rows[place] = _rows_of_a_crop(points, n_points, crop, rng, path)
        drawn = points[rows[place]]
        # Before float32, which has too few digits for coordinates of a map.
        centred[place] = drawn - drawn.mean(0)
    return Crops(centred, rows)


def _rows_of_a_crop(
    points: NDArray[np.float64], n_points: int, crop: Crop, rng: np.random.Generator, path: Path
) -> NDArray[np.int64]:
    """Draw until not all points of the crop coincide."""
    for _ in range(DRAWS):
        if crop == "nearest":
            rows = _nearest_to_a_drawn_point(points, n_points, rng)
        else:
            rows = rng.choice(len(points), n_points, replace=False)
        drawn = points[rows]
        if (drawn != drawn[0]).any():
            return rows
    raise BadCloudError(f"{path}: the {n_points} points of a crop coincide. Clean it.")


def _nearest_to_a_drawn_point(
    points: NDArray[np.float64], n_points: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    centre = points[rng.integers(len(points))]
    distance = np.square(points - centre).sum(1)
    nearest = np.argpartition(distance, n_points - 1)[:n_points]
    return np.sort(nearest)
