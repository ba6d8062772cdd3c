"""Crops: parts of a cloud, each with as many points as a net is trained on."""

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mops_lightning.data.formats.guard import BadCloudError
from mops_lightning.samplers.tiles import balanced_tiles

Crop = Literal["nearest", "whole", "surface", "tiles"]
CROPS = ("nearest", "whole", "surface", "tiles")

CROPS_PER_FILE = {
    "nearest": 32,
    "whole": 1,
    "surface": 1,
    "tiles": None,
}
"""Number of clouds that are drawn from a file, unless ``crops`` sets it; tiles follow the file."""

DRAWS = 50
"""Crops that are drawn before a file is rejected because all points of a crop coincide."""


class Crops(NamedTuple):
    """Crops of one cloud.

    Attributes:
        points: ``(crops, n_points, 3)`` float32, each crop with its centroid at the origin.
        rows: ``(crops, n_points)`` int64, the rows of these points in the cloud.
        own: ``(crops, n_points)``, which points belong to the crop; others are in the tile of
            another crop, too, and have no part in this one. None: all.
    """

    points: NDArray[np.float32]
    rows: NDArray[np.int64]
    own: NDArray[np.bool_] | None = None


def random_crops(
    points: NDArray[np.float64],
    n_points: int | None,
    number: int | None,
    crop: Crop,
    rng: np.random.Generator,
    path: Path,
) -> Crops:
    """Draw crops of a cloud, or cut it into tiles.

    Args:
        points: ``(N, 3)``.
        n_points: number of points per crop; None: all, in random order.
        number: of crops; None for tiles.
        crop: ``nearest``, ``whole`` or ``tiles``, as in ``cloud_folder.cloud_folder``.
        rng: random generator.
        path: of the file, for errors.

    Raises:
        BadCloudError: the cloud has fewer than ``n_points`` points, or they coincide.
    """
    if n_points is None:
        n_points = len(points)
    if len(points) < n_points:
        raise BadCloudError(
            f"{path} has {len(points)} points, fewer than dataset.n_points={n_points}. Lower "
            "dataset.n_points, or remove the file."
        )
    if number is None:
        return _tiles(points, n_points)
    rows = np.empty((number, n_points), np.int64)
    for place in range(number):
        rows[place] = _rows_of_a_crop(points, n_points, crop, rng, path)
    return Crops(_centred(points, rows), rows)


def _centred(points: NDArray[np.float64], rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the points of crops, each with its centroid at the origin."""
    centred = np.empty((*rows.shape, 3), np.float32)
    for place, chosen in enumerate(rows):
        drawn = points[chosen]
        # Before float32, which has too few digits for coordinates of a map.
        centred[place] = drawn - drawn.mean(0)
    return centred


def _tiles(points: NDArray[np.float64], n_points: int) -> Crops:
    """Cut a cloud into tiles of at most ``n_points`` points, each filled up by its neighbours.

    Every point is a tile's own once. A tile with fewer points also has the nearest points of other
    tiles, which are not its own.
    """
    tree = cKDTree(points)
    tiles = balanced_tiles(points, n_points)
    rows = np.empty((len(tiles), n_points), np.int64)
    own = np.zeros((len(tiles), n_points), np.bool_)
    for place, tile in enumerate(tiles):
        number = len(tile)
        rows[place, :number] = tile
        own[place, :number] = True
        missing = n_points - number
        if missing:
            # Of the nearest n_points + missing points, at least ``missing`` are in other tiles.
            most = min(n_points + missing, len(points))
            near = np.asarray(tree.query(points[tile].mean(0), most)[1])
            others = near[~np.isin(near, tile)]
            rows[place, number:] = others[:missing]
    return Crops(_centred(points, rows), rows, own)


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
