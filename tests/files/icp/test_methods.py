"""Methods of downsampling in comparisons by registration."""

from pathlib import Path

import numpy as np

from mops_lightning.files.icp.methods import VoxelFilter


def test_voxels_of_small_gicp_keep_as_many_points_as_are_asked_for_where_they_can():
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), -1).reshape(-1, 3)

    eight = VoxelFilter().sample(corners, 8, 0, Path("scan.ply")).points
    seven = VoxelFilter().sample(corners, 7, 0, Path("scan.ply")).points

    assert sorted(eight.round(6).tolist()) == sorted(corners.tolist())
    assert 1 <= len(seven) <= 7
