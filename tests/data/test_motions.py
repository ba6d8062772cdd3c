import numpy as np
import pytest

from mops_lightning.data.motions import PoseRules, read_motions
from mops_lightning.errors import UserError
from tests.support.scans import moved, pose, write_log, write_poses

POSES = [pose(seed) for seed in range(5)]
POINTS = np.random.default_rng(0).normal(size=(20, 3))
NO_ROTATION = "2 0 0 0 0 1 0 0 0 0 1 0\n"


def ends(pairs):
    return [(pair.source, pair.target) for pair in pairs]


def seen_from(matrix):
    return moved(POINTS, np.linalg.inv(matrix))


@pytest.mark.parametrize("gap", [None, 1, 3])
def test_poses_motion_maps_source_to_target(tmp_path, gap):
    write_poses(tmp_path / "poses.txt", POSES)
    pairs = read_motions(tmp_path / "poses.txt", 5, PoseRules(gap=gap))
    assert ends(pairs) == [(i, i + (gap or 1)) for i in range(5 - (gap or 1))]
    for i, j, motion in pairs:
        np.testing.assert_allclose(moved(seen_from(POSES[i]), motion), seen_from(POSES[j]))


def test_poses_distance_chooses_all_near_pairs(tmp_path):
    poses = [np.eye(4) for _ in range(4)]
    for matrix, x in zip(poses, (0, 1, 5, 5.5), strict=True):
        matrix[0, 3] = x
    write_poses(tmp_path / "poses.txt", poses)
    assert ends(read_motions(tmp_path / "poses.txt", 4, PoseRules(distance=1.0))) == [
        (0, 1),
        (2, 3),
    ]
    with pytest.raises(UserError, match=r"^distance=0\.1: the 4 poses .*no such pair"):
        read_motions(tmp_path / "poses.txt", 4, PoseRules(distance=0.1))


def test_poses_of_camera_need_calibration(tmp_path):
    calibration = pose(9, angle=90)
    write_poses(tmp_path / "poses.txt", POSES)
    numbers = " ".join(map(repr, calibration[:3].ravel().tolist()))
    (tmp_path / "calib.txt").write_text(f"P0: 1 2 3\nTr: {numbers}\n")
    rules = PoseRules(tmp_path / "calib.txt")
    for i, j, motion in read_motions(tmp_path / "poses.txt", 5, rules):
        laser = [moved(seen_from(POSES[k]), np.linalg.inv(calibration)) for k in (i, j)]
        np.testing.assert_allclose(moved(laser[0], motion), laser[1], atol=1e-12)
    (tmp_path / "calib.txt").write_text("P0: 1 2 3\n")
    with pytest.raises(UserError, match=r"calib: .*calib\.txt has no line 'Tr:'"):
        read_motions(tmp_path / "poses.txt", 5, rules)


def test_log_matrix_maps_second_scan_to_first(tmp_path):
    write_log(tmp_path / "gt.log", POSES, [(0, 2), (3, 1)])
    pairs = read_motions(tmp_path / "gt.log", 5, PoseRules())
    assert ends(pairs) == [(2, 0), (1, 3)]
    for source, target, motion in pairs:
        mapped = moved(seen_from(POSES[source]), motion)
        np.testing.assert_allclose(mapped, seen_from(POSES[target]))


def test_rounded_rotation_is_made_exact(tmp_path):
    np.savetxt(tmp_path / "poses.txt", [matrix[:3].ravel() for matrix in POSES], fmt="%.4f")
    for _, _, motion in read_motions(tmp_path / "poses.txt", 5, PoseRules()):
        rotation = motion[:3, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)


STILL = "1 0 0 0 0 1 0 0 0 0 1 0\n"
ROWS = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "first line"),
        ("1 2\n", "got 2 words"),
        (STILL, "has 1 poses, but there are 2 scans"),
        (STILL + "\n" + NO_ROTATION, r"line 3: not a rigid motion.* 0\.001 .* by 3"),
        (STILL + "-1 0 0 0 0 1 0 0 0 0 1 0\n", "line 2: not a rigid motion.*determinant is -1"),
        (STILL + "nan 0 0 0 0 1 0 0 0 0 1 0\n", "line 2: .*finite numbers"),
        (STILL + "1 0 0 x 0 1 0 0 0 0 1 0\n", "line 2: .*finite numbers"),
        (STILL + "1 0 0\n", "line 2: .*finite numbers"),
        ("0 1 2\n" + ROWS.replace("0 0 1 0\n", ""), "line 1: .*four lines of four"),
        ("0 1 2\n" + ROWS[:-8], "line 1: .*four lines of four"),
        ("0 1 2\n" + ROWS + "a b c\n" + ROWS, "line 6: must be 'i j n'"),
        ("0 1 7\n" + ROWS, "line 1: n must be the number of scans, got 7, but there are 2"),
        ("0 2 2\n" + ROWS, "line 1: .* from 0 to 1, .*got 0 and 2"),
        ("1 1 2\n" + ROWS, "line 1: .*got 1 and 1"),
        (2 * ("0 1 2\n" + ROWS), "line 6: .*each pair once"),
        ("0 1 2\n" + ROWS.replace("1 0 0 0", "inf 0 0 0"), "line 1: .*finite numbers"),
        ("0 1 2\n" + ROWS[:-2] + "2\n", "line 1: not a rigid motion.*fourth row"),
    ],
)
def test_bad_file_names_line(tmp_path, text, message):
    (tmp_path / "file.txt").write_text(text)
    with pytest.raises(UserError, match=rf"^motions: .*file\.txt.*{message}") as error:
        read_motions(tmp_path / "file.txt", 2, PoseRules())
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gap": 0}, "gap must be at least 1"),
        ({"distance": 0.0}, "distance must be above 0"),
        ({"gap": 1, "distance": 1.0}, "gap and distance .* give one"),
    ],
)
def test_pose_rules_out_of_range_raise(settings, message):
    with pytest.raises(UserError, match=message):
        PoseRules(**settings)


def test_settings_of_poses_with_log_raise(tmp_path):
    write_log(tmp_path / "gt.log", POSES, [(0, 2)])
    with pytest.raises(UserError, match=r"lists its pairs .*leave out gap"):
        read_motions(tmp_path / "gt.log", 5, PoseRules(gap=1))


def test_missing_or_binary_file_raises(tmp_path):
    with pytest.raises(UserError, match="motions: cannot read"):
        read_motions(tmp_path / "none.txt", 5, PoseRules())
    (tmp_path / "poses.txt").write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(UserError, match="motions: cannot read"):
        read_motions(tmp_path / "poses.txt", 5, PoseRules())
