"""Other libraries with farthest point sampling or nearest points, where they are installed.

Each is called as its documentation says, on its own type of array; the conversion is not timed.
None is required: ``pip install fpsample open3d-cpu point-cloud-utils``, in a separate environment
if their requirements conflict with ours.
"""

from collections.abc import Callable
from functools import partial
from importlib import import_module, metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

Calls = dict[str, Callable[[], Any]]
"""Functions to time, by name."""

EXHAUSTIVE = 2**28
"""Maximum number of distances for libraries that compute all of them."""


def installed(name: str) -> Any:
    """Return a library, or None if it is not installed."""
    try:
        return import_module(name)
    except ImportError:
        return None


def versions() -> dict[str, str]:
    """Return the versions of the installed libraries, by their names in pip."""
    found = {}
    names = (
        "scipy",
        "numba",
        "fpsample",
        "open3d",
        "open3d-cpu",
        "point-cloud-utils",
        "small_gicp",
    )
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def farthest(points: Tensor, m: int) -> Calls:
    """Return calls that choose m points ``(m, 3)`` from ``(N, 3)``, starting at row 0.

    fpsample's bucket variants start at a row of their own choice and ignore the given one.
    """
    array, calls = points.numpy(), Calls()
    if fpsample := installed("fpsample"):
        for height in (3, 5, 7, 9):  # 2^height buckets; the fastest height depends on the size

            def by_buckets(height: int = height) -> NDArray[np.float32]:
                rows = fpsample.bucket_fps_kdline_sampling(array, m, height, 0)
                return np.asarray(array[rows])

            calls[f"fpsample, {2**height} buckets"] = by_buckets
        if len(array) * m <= EXHAUSTIVE:
            calls["fpsample, plain"] = lambda: array[fpsample.fps_sampling(array, m, 0)]
    if len(array) * m <= EXHAUSTIVE and (open3d := installed("open3d")):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(array.astype(float)))
        calls["Open3D"] = lambda: np.asarray(cloud.farthest_point_down_sample(m, 0).points)
    return calls


def nearest(queries: Tensor, points: Tensor) -> Calls:
    """Return calls that find the row of the nearest of ``(N, 3)`` points for ``(M, 3)`` queries.

    Building the library's index, a tree in most, is part of the call.
    """
    many, few = points.numpy(), queries.numpy()

    def by_scipy() -> NDArray[np.int64]:
        return np.asarray(cKDTree(many).query(few, workers=-1)[1])

    calls: Calls = {"scipy": by_scipy}
    if utils := installed("point_cloud_utils"):
        calls["point-cloud-utils"] = partial(_second, utils.k_nearest_neighbors, few, many, 1)
    if open3d := installed("open3d"):
        core = open3d.core

        def by_open3d() -> NDArray[np.int64]:
            search = core.nns.NearestNeighborSearch(core.Tensor(many))
            search.knn_index()
            return search.knn_search(core.Tensor(few), 1)[0].numpy().ravel()

        calls["Open3D"] = by_open3d
    return calls


def _second(function: Callable[..., Any], *arguments: Any) -> Any:
    return function(*arguments)[1].ravel()
