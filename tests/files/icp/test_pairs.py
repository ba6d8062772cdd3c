"""Pairs of clouds, and the poses from which their registration starts."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mops_lightning.errors import UserError
from mops_lightning.files.icp.pairs import Pair, crop_pairs, draw_motions, frame_pairs, scans_of
from tests.support.clouds import normal_points

SCAN = Path("scan.ply")


def test_halves_of_crops_share_no_point_and_fill_the_unit_sphere():
    unit = np.random.default_rng(0).uniform(-9, 9, (500, 3))
    points = unit + np.array([4e5, 5e6, 0])

    pairs = crop_pairs([(SCAN, points)], 100, 3, seed=0)

    assert len(pairs) == 3
    for pair in pairs:
        assert pair.source.shape == (50, 3)
        assert pair.target.shape == (50, 3)
        together = np.concatenate([pair.source, pair.target])
        assert len(np.unique(together, axis=0)) == 100
        radii = np.linalg.norm(together, axis=1)
        assert radii.max() == pytest.approx(1)
        assert pair.truth.tolist() == np.eye(4).tolist()


def test_crops_depend_on_the_seed_alone():
    points = normal_points(500, 0)

    _, first = crop_pairs([(SCAN, points)], 100, 2, seed=0)
    _, again = crop_pairs([(SCAN, points)], 100, 2, seed=0)
    _, other = crop_pairs([(SCAN, points)], 100, 2, seed=1)

    assert first.source.tolist() == again.source.tolist()
    assert first.source.tolist() != other.source.tolist()


def test_crops_name_a_scan_of_too_few_points():
    with pytest.raises(UserError, match=r"scan.ply has 99 points, fewer than --points 100"):
        crop_pairs([(SCAN, np.zeros((99, 3)))], 100, 1, seed=0)


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
    frames = [(Path("0.ply"), first), (Path("1.ply"), second)]

    (pair,) = frame_pairs(frames, poses)

    rotation = pair.truth[:3, :3]
    translation = pair.truth[:3, 3]
    moved = pair.source @ rotation.T + translation
    assert moved == pytest.approx(pair.target)


def test_frames_need_a_pose_each(tmp_path):
    poses = tmp_path / "poses.txt"
    poses.write_text("1 0 0 1 0 1 0 0 0 0 1 0\n")

    with pytest.raises(UserError, match="has 1 poses for 2 frames"):
        frame_pairs([(SCAN, np.zeros((9, 3)))] * 2, poses)


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
        angles.append(Rotation.from_matrix(rotation).magnitude())
        shifts.append(np.linalg.norm(moved_centre - centre))
    assert 14 < np.degrees(max(angles)) <= 15
    assert 0.09 < max(shifts) <= 0.1


def test_starts_of_frames_are_drawn_about_the_true_motion():
    points = np.random.default_rng(0).normal((20, 0, 0), size=(300, 3))
    truth = np.eye(4)
    truth[:3, :3] = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    truth[:3, 3] = 5, 6, 7
    target = points @ truth[:3, :3].T + truth[:3, 3]
    pair = Pair(SCAN, points, target, truth)

    (starts,) = draw_motions([pair], 50, angle=15.0, shift=0.1, seed=0)

    true_centre = target.mean(0)
    for start in starts:
        turn = Rotation.from_matrix(start[:3, :3] @ truth[:3, :3].T)
        centre = start[:3, :3] @ points.mean(0) + start[:3, 3]
        assert np.degrees(turn.magnitude()) <= 15
        assert np.linalg.norm(centre - true_centre) <= 0.1


def test_scans_are_in_the_order_of_their_numbers(tmp_path):
    for name in ("f_10.ply", "f_9.ply", ".hidden.ply", "notes.md"):
        (tmp_path / name).touch()

    assert [path.name for path in scans_of(tmp_path)] == ["f_9.ply", "f_10.ply"]
