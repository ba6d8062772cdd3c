"""The error of a pose."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mops_lightning.files.icp.align import pose_difference

CENTRE = np.array([1000.0, 0.0, 5.0])
"""A scan far from the origin."""


def test_pose_difference_is_the_shift_of_the_centre_not_of_the_origin():
    rotation = Rotation.from_euler("z", 2, degrees=True).as_matrix()
    truth = np.eye(4)
    found = np.eye(4)
    found[:3, :3] = rotation
    found[:3, 3] = CENTRE - rotation @ CENTRE + [0.0, 0.3, 0.4]

    degrees, shift = pose_difference(found, truth, CENTRE)

    assert degrees == pytest.approx(2.0)
    assert shift == pytest.approx(0.5)
