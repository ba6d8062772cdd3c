"""Methods of downsampling in comparisons by registration."""

from pathlib import Path

import numpy as np

from mops_lightning.files.icp.methods import ByName, VoxelFilter
from tests.support.clouds import normal_points

SCAN = Path("scan.ply")


def test_voxels_of_small_gicp_keep_as_many_points_as_are_asked_for_where_they_can():
    corners = np.indices((2, 2, 2), float).reshape(3, 8).T
    voxels = VoxelFilter()

    eight = voxels.sample(corners, 8, 0, SCAN).points
    seven = voxels.sample(corners, 7, 0, SCAN).points

    rounded = eight.round(6).tolist()
    assert sorted(rounded) == sorted(corners.tolist())
    assert 1 <= len(seven) <= 7


def test_voxels_of_small_gicp_take_map_coordinates(capfd):
    """Beyond voxel 2^20 from the origin, the library leaves points out, and warns."""
    local = normal_points(2000, 0).astype(np.float64)
    utm = local + np.array([500_000.0, 4_649_000.0, 200.0])

    kept = VoxelFilter().sample(utm, 64, 0, SCAN).points

    assert 48 <= len(kept) <= 64
    assert np.ptp(kept, axis=0).min() > np.ptp(local, axis=0).min() / 2
    assert capfd.readouterr().err == ""


def test_method_by_name_depends_on_the_seed():
    points = normal_points(200, 0)
    method = ByName("random")

    first = method.sample(points, 20, 3, SCAN).points.tolist()
    again = method.sample(points, 20, 3, SCAN).points.tolist()
    other = method.sample(points, 20, 4, SCAN).points.tolist()

    assert first == again
    assert sorted(first) != sorted(other)


def test_fps_farthest_starts_at_the_point_farthest_from_the_mean():
    points = normal_points(200, 0)
    points[7] = [90, 0, 0]

    kept = ByName("fps_farthest").sample(points, 1, 0, SCAN).points

    assert kept.tolist() == [[90, 0, 0]]
