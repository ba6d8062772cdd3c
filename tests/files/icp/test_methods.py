"""Methods of downsampling in comparisons by registration."""

from pathlib import Path

import numpy as np

from mops_lightning.files.icp.methods import VoxelFilter

SCAN = Path("scan.ply")


def test_voxels_of_small_gicp_keep_as_many_points_as_are_asked_for_where_they_can():
    corners = np.indices((2, 2, 2), float).reshape(3, 8).T
    voxels = VoxelFilter()

    eight = voxels.sample(corners, 8, 0, SCAN).points
    seven = voxels.sample(corners, 7, 0, SCAN).points

    rounded = eight.round(6).tolist()
    assert sorted(rounded) == sorted(corners.tolist())
    assert 1 <= len(seven) <= 7
