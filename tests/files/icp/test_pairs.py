"""Pairs of clouds, and the poses from which their registration starts."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation

from mops_lightning.errors import UserError
from mops_lightning.files.icp.pairs import Pair, crop_pairs, draw_motions, frame_pairs, scans_of
from tests.support.clouds import normal_points, uniform_points

SCAN = Path("scan.ply")


def test_halves_of_crops_share_no_point_and_fill_the_unit_sphere():
    unit = uniform_points(500, 0)
    points = 18 * unit + np.array([4e5, 5e6, 0])

    pairs = crop_pairs([(SCAN, points)], 100, 3, seed=0)

    assert len(pairs) == 3
    for pair in pairs:
        together = np.concatenate([pair.source, pair.target])
        different = np.unique(together, axis=0)
        radii = np.linalg.norm(together, axis=1)
        assert pair.source.shape == (50, 3)
        assert pair.target.shape == (50, 3)
        assert len(different) == 100
        assert radii.max() == pytest.approx(1)
        assert_array_equal(pair.truth, np.eye(4))


def test_crops_depend_on_the_seed_alone():
    points = normal_points(500, 0)
    scans = [(SCAN, points)]

    _, first = crop_pairs(scans, 100, 2, seed=0)
    _, again = crop_pairs(scans, 100, 2, seed=0)
    _, other = crop_pairs(scans, 100, 2, seed=1)

    assert np.array_equal(first.source, again.source)
    assert not np.array_equal(first.source, other.source)


def test_crops_of_two_scans_are_drawn_apart():
    points = normal_points(500, 0)
    scans = [(Path("a.ply"), points), (Path("b.ply"), points)]

    first, second = crop_pairs(scans, 100, 1, seed=0)

    assert not np.array_equal(first.source, second.source)


def test_crops_name_a_scan_of_too_few_points():
    points = np.zeros((99, 3))

    with pytest.raises(UserError, match=r"scan.ply has 99 points, fewer than --points 100"):
        crop_pairs([(SCAN, points)], 100, 1, seed=0)


def test_frames_are_aligned_to_the_one_before(tmp_path):
    poses = tmp_path / "poses.txt"
    poses.write_text("1 0 0 1 0 1 0 0 0 0 1 0\n0 -1 0 3 1 0 0 0 0 0 1 0\n")
    quarter_turn = np.array(
        [
            [0.0, -1.0, 0.0],
            [1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    room = normal_points(20, 0)
    first = room - [1, 0, 0]
    second = (room - [3, 0, 0]) @ quarter_turn
    frames = [
        (Path("0.ply"), first),
        (Path("1.ply"), second),
    ]

    (pair,) = frame_pairs(frames, poses)

    rotation = pair.truth[:3, :3]
    translation = pair.truth[:3, 3]
    moved = pair.source @ rotation.T + translation
    assert moved == pytest.approx(pair.target)


def test_frames_need_a_pose_each(tmp_path):
    poses = tmp_path / "poses.txt"
    poses.write_text("1 0 0 1 0 1 0 0 0 0 1 0\n")
    frame = (SCAN, np.zeros((9, 3)))

    with pytest.raises(UserError, match="has 1 poses for 2 frames"):
        frame_pairs([frame, frame], poses)


def degrees_of(rotation):
    """Return the angle of a matrix ``(3, 3)``."""
    radians = Rotation.from_matrix(rotation).magnitude()
    return np.degrees(radians)


def test_starts_are_within_the_angle_and_shift_about_the_mean_of_the_source():
    points = normal_points(300, 0)
    (pair,) = crop_pairs([(SCAN, points)], 100, 1, 0)

    (starts,) = draw_motions([pair], 200, angle=15.0, shift=0.1, seed=0)

    centre = pair.source.mean(0)
    angles = []
    shifts = []
    for start in starts:
        rotation = start[:3, :3]
        moved_centre = rotation @ centre + start[:3, 3]
        shift = np.linalg.norm(moved_centre - centre)
        angles.append(degrees_of(rotation))
        shifts.append(shift)
    assert 14 < max(angles) <= 15
    assert 0.09 < max(shifts) <= 0.1


def test_starts_of_frames_are_drawn_about_the_true_motion():
    points = normal_points(300, 0) + np.array([20, 0, 0])
    quarter_turn = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    truth = np.eye(4)
    truth[:3, :3] = quarter_turn
    truth[:3, 3] = 5, 6, 7
    target = points @ quarter_turn.T + [5, 6, 7]
    pair = Pair(SCAN, points, target, truth)

    (starts,) = draw_motions([pair], 50, angle=15.0, shift=0.1, seed=0)

    centre = points.mean(0)
    true_centre = target.mean(0)
    for start in starts:
        rotation = start[:3, :3]
        started_centre = rotation @ centre + start[:3, 3]
        shift = np.linalg.norm(started_centre - true_centre)
        assert degrees_of(rotation @ quarter_turn.T) <= 15
        assert shift <= 0.1


def test_scans_are_in_the_order_of_their_numbers(tmp_path):
    for name in ("f_10.ply", "f_9.ply", ".hidden.ply", "notes.md"):
        (tmp_path / name).touch()

    scans = scans_of(tmp_path)

    assert [path.name for path in scans] == ["f_9.ply", "f_10.ply"]


def test_scans_of_folders_follow_each_other(tmp_path):
    for name in ("b/f_1.ply", "a/f_2.ply", "a/f_10.ply"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()

    scans = scans_of(tmp_path)

    names = [path.relative_to(tmp_path).as_posix() for path in scans]
    assert names == ["a/f_2.ply", "a/f_10.ply", "b/f_1.ply"]
