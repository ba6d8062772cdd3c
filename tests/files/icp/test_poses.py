"""Files of poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mops_lightning.errors import UserError
from mops_lightning.files.icp.poses import read_poses

TURN = Rotation.from_euler("z", 90, degrees=True)


def test_poses_of_kitti_and_tum_are_the_same_motions(tmp_path):
    kitti, tum = tmp_path / "kitti.txt", tmp_path / "tum.txt"
    kitti.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n\n0 -1 0 5 1 0 0 6 0 0 1 7\n")
    x, y, z, w = TURN.as_quat()
    tum.write_text(f"# time and pose\n0.0 0 0 0 0 0 0 1\n0.1 5 6 7 {x} {y} {z} {w}\n")

    for path in (kitti, tum):
        poses = read_poses(path)

        assert poses[0].tolist() == np.eye(4).tolist()
        assert poses[1] @ [1, 0, 0, 1] == pytest.approx([5, 7, 7, 1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no pose. Give 12 numbers a line"),
        ("# only a remark\n", "has no pose"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 2 3\n", "line 2 of .* is no pose"),
        ("1 0 0 0 0 1 0 0 0 0 1 x\n", "line 1 of .* is no pose"),
        ("1 0 0 nan 0 1 0 0 0 0 1 0\n", "line 1 of .* is no pose"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n", "line 1 of .* has no rotation"),
        ("0 1 2 3 0 0 0 0\n", "line 1 of .* has no unit quaternion"),
    ],
)
def test_poses_name_the_line_that_is_none(tmp_path, text, message):
    path = tmp_path / "poses.txt"
    path.write_text(text)

    with pytest.raises(UserError, match=message):
        read_poses(path)


def test_poses_name_a_file_that_cannot_be_read(tmp_path):
    binary = tmp_path / "poses.bin"
    binary.write_bytes(b"\xff\xfe\x00")

    with pytest.raises(UserError, match="cannot be read as text"):
        read_poses(binary)
    with pytest.raises(UserError, match="cannot be read as text"):
        read_poses(tmp_path / "nowhere.txt")
